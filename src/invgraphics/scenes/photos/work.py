"""The work process: ``python -m invgraphics.scenes.photos.work FOLDER`` does what ``FOLDER/job.json`` asks for.

It runs apart from the caller because pycolmap may end a process that gets a signal, or that runs out of memory, without a word.
Stages that an interrupted process has finished are kept.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.scenes.photos import sfm
from invgraphics.scenes.photos.job import QUALITY, SCHEMA, TOP_VIEW, PhotoJob
from invgraphics.scenes.photos.maker import JOB, RESULT
from invgraphics.scenes.photos.pairs import Evidence, read_evidence
from invgraphics.scenes.photos.plot import top_view
from invgraphics.scenes.photos.prepare import PREPARED, Preparation, prepare
from invgraphics.scenes.photos.quality import NOTHING, describe, refusal, unplaced
from invgraphics.scenes.photos.result import write_scene
from invgraphics.scenes.photos.suspicion import examine
from invgraphics.scenes.process import say_error, say_progress

STEPS = {"read": 10, "features": 20, "matches": 35, "poses": 25, "check": 3, "pictures": 7}
"""Stages in their order, and about how many per cent of the time each takes."""


class Clock:
    """Turns the progress of one stage into that of the whole, and keeps the time each took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "", time.perf_counter()

    def start(self, stage: str) -> None:
        """The stage before is over."""
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = round(now - self._since, 2)
        self._stage, self._since = stage, now

    def show(self, done: int, total: int, what: str) -> None:
        """Say how far the present stage is."""
        before = sum(share for stage, share in STEPS.items() if list(STEPS).index(stage) < list(STEPS).index(self._stage))
        say_progress(round(before + STEPS[self._stage] * done / max(total, 1)), 100, what)


def main(work: Path) -> None:
    """Do the whole work and leave it in ``work``/result."""
    from invgraphics.scenes.colmap_library import pycolmap

    pycolmap.logging.minloglevel = 2
    asked = json.loads((work / JOB).read_text(encoding="utf-8"))
    job = PhotoJob.parse(json.dumps(asked["job"]))
    result = work / RESULT
    shutil.rmtree(result, ignore_errors=True)
    result.mkdir()
    clock = Clock()
    clock.start("read")
    preparation = _prepared(job, work, clock)
    clock.start("features")
    sfm.enter(job, preparation.photos, work)
    sfm.extract(preparation.photos, work, clock.show)
    clock.start("matches")
    sfm.match(job, preparation.photos, work, clock.show)
    clock.start("poses")
    models = sfm.reconstruct(job, preparation.photos, work, clock.show)
    evidence = read_evidence(work / sfm.DATABASE, preparation.photos)
    quality = _finish(job, preparation, evidence, models, (work, result), clock)
    partial = result / f"{QUALITY}.partial"
    partial.write_text(json.dumps({"schema": SCHEMA, "key": asked["key"], **quality}, indent=1), encoding="utf-8")
    partial.replace(result / QUALITY)


def _prepared(job: PhotoJob, work: Path, clock: Clock) -> Preparation:
    path = work / PREPARED
    if path.is_file():
        return Preparation.read(path)
    preparation = prepare(job, work, clock.show)
    preparation.write(path.with_suffix(".partial"))
    path.with_suffix(".partial").replace(path)
    return preparation


def _finish(
    job: PhotoJob,
    preparation: Preparation,
    evidence: Evidence,
    models: list[Any],
    places: tuple[Path, Path],
    clock: Clock,
) -> dict[str, Any]:
    """Examine the largest piece, write it down, and return the report."""
    photos = preparation.photos
    figures, suspicion, bend = NOTHING, None, 0.0
    if models:
        clock.start("check")
        figures = describe(models[0], photos)
        clock.show(0, 1, "checking pairs against the whole")
        suspicion = examine(models[0], photos, evidence)
        clock.start("pictures")
        title = f"{job.path.name}: {figures['registered']} of {len(photos)} photographs, {figures['points']} points"
        top_view(models[0], title, places[1] / TOP_VIEW)
        bend = write_scene(models[0], photos, *places, clock.show)
    clock.start("")
    refused = refusal(photos, evidence, figures["registered"])
    return {
        "job": json.loads(job.text()),
        "given": len(photos) + len(preparation.skipped),
        "used": len(photos),
        **figures,
        "bend_px": bend,
        "other_pieces": [model.num_reg_images() for model in models[1:]],
        "suspicion": suspicion,
        "usable": refused is None,
        "refusal": refused,
        "skipped": preparation.skipped,
        "unplaced": unplaced(photos, evidence, {camera["name"] for camera in figures["cameras"]}),
        "seconds": clock.seconds,
    }


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except InputError as error:
        say_error(error)
        sys.exit(1)
    except OSError as error:
        say_error(InputError(f"{sys.argv[1]} cannot be written: {error.strerror or error}.", "Choose another --out."))
        sys.exit(1)
