"""The work process: ``python -m invgraphics.scenes.photos.work FOLDER`` does the job of ``FOLDER/job.json``.

It runs apart from the caller because pycolmap may end a process that gets a signal, or that runs out of memory, without a word.
Stages that an interrupted process has finished are kept.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.scenes.photos import sfm
from invgraphics.scenes.photos.attempts import Attempt, choice, try_all_pairs, try_strategies
from invgraphics.scenes.photos.job import DATABASE, QUALITY, SCHEMA, TOP_VIEW, PhotoJob
from invgraphics.scenes.photos.maker import JOB, RESULT
from invgraphics.scenes.photos.mapping import Matched
from invgraphics.scenes.photos.pairs import read_verified_matches
from invgraphics.scenes.photos.plot import top_view
from invgraphics.scenes.photos.prepare import PREPARED, Preparation, prepare
from invgraphics.scenes.photos.quality import EMPTY_FIGURES, describe, refusal, unplaced
from invgraphics.scenes.photos.result import write_scene
from invgraphics.scenes.pictures.profiles import profile_words
from invgraphics.scenes.process import worker_main, write_progress
from invgraphics.tables import parse_json, read_json

STEPS = {"read": 10, "features": 20, "matches": 35, "poses": 27, "pictures": 8}
"""Stages in their order, and about how many per cent of the time each takes."""


class Clock:
    """Maps the progress of stages to that of the whole, and records their seconds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "", time.perf_counter()

    def start(self, stage: str) -> None:
        """Begin a stage."""
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = round(now - self._since, 2)
        self._stage, self._since = stage, now

    def show(self, done: int, total: int, what: str) -> None:
        """Report the progress of the present stage."""
        before = sum(share for stage, share in STEPS.items() if list(STEPS).index(stage) < list(STEPS).index(self._stage))
        write_progress(round(before + STEPS[self._stage] * done / max(total, 1)), 100, what)


def main(work: Path) -> None:
    """Do the whole work and leave it in ``work``/result."""
    asked = read_json(work / JOB)
    job = PhotoJob.parse(json.dumps(asked["job"]))
    result = work / RESULT
    shutil.rmtree(result, ignore_errors=True)
    result.mkdir()
    clock = Clock()
    clock.start("read")
    preparation = _prepared(job, work, clock)
    clock.start("features")
    sfm.write_database(job, preparation.photos, work)
    sfm.extract(preparation.photos, work, clock.show)
    clock.start("matches")
    wanted = sfm.pairs(len(preparation.photos), job.matching)
    sfm.match(wanted, preparation.photos, work / DATABASE, clock.show, sfm.Verification(job.seed))
    clock.start("poses")
    evidence = read_verified_matches(work / DATABASE, preparation.photos)
    matched = Matched(job, preparation.photos, evidence, work)
    matched, best, attempts = try_all_pairs(matched, *try_strategies(matched, clock.show), clock.show)
    quality = _finish(matched, preparation.skipped, best, result, clock) | {"choice": choice(attempts), "attempts": attempts}
    write_text(result / QUALITY, json.dumps({"schema": SCHEMA, "key": asked["key"], **quality}, indent=1))


def _prepared(job: PhotoJob, work: Path, clock: Clock) -> Preparation:
    path = work / PREPARED
    if path.is_file():
        return Preparation.read(path)
    preparation = prepare(job, work, clock.show)
    preparation.write(path)
    return preparation


def _finish(matched: Matched, skipped: dict[str, str], best: Attempt, result: Path, clock: Clock) -> dict[str, Any]:
    """Write the largest piece of the best attempt; returns the report."""
    job, photos = matched.job, matched.photos
    figures, bend = EMPTY_FIGURES, 0.0
    if best.pieces:
        figures = describe(best.pieces[0], photos)
        clock.start("pictures")
        title = f"{job.path.name}: {figures['registered']} of {len(photos)} photographs, {figures['points']} points"
        top_view(best.pieces[0], title, result / TOP_VIEW)
        bend = write_scene(best.pieces[0], photos, matched.work, result, clock.show)
    clock.start("")
    refused = refusal(photos, matched.evidence, [camera["points"] for camera in figures["cameras"]])
    placed = {camera["name"] for camera in figures["cameras"]}
    return {
        "job": parse_json(job.text(), "the job"),
        "given": len(photos) + len(skipped),
        "used": len(photos),
        "masked": sum(photo.own_mask for photo in photos),
        **profile_words([photo.profile for photo in photos]),
        **figures,
        "bend_px": bend,
        "other_pieces": [model.num_reg_images() for model in best.pieces[1:]],
        "consistency": best.consistency,
        "usable": refused is None,
        "refusal": refused,
        "skipped": skipped,
        "unplaced": unplaced(photos, matched.evidence, placed, best.outliers, best.pieces[1:]),
        "seconds": clock.seconds,
    }


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"{folder} cannot be written: {error.strerror or error}.", "Choose another --out.")


if __name__ == "__main__":
    worker_main(main, _unwritable)
