"""The rendering process of a class of objects: ``python -m invgraphics.scenes.mitsuba.instances FOLDER``.

Its pictures are small and many: each instance is one file of arrays, so that an interrupted process can be continued, and all
of them are joined to one data set in the format of `invgraphics.scenes.npz` in the end. An instance is built once for all its
views, and its kernels are those of the one before.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from invgraphics.arrays import read_arrays
from invgraphics.core import Camera
from invgraphics.core.colour import quantise
from invgraphics.files import write_arrays, write_text
from invgraphics.scenes.mitsuba import cache, render, stage
from invgraphics.scenes.mitsuba import folder as folders
from invgraphics.scenes.mitsuba.gbuffer import trace
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.rig import Split, cameras, make_rig
from invgraphics.scenes.process import worker_main, write_progress
from invgraphics.tables import read_json

PARTS = "instances"
"""Folder of the instances' files until they are joined."""


def main(folder: Path) -> None:
    """Render the instances that are missing in ``folder``, and join them."""
    import mitsuba

    job = Job.from_json((folder / cache.REQUEST).read_text(encoding="utf-8"))
    instances = job.spec.instances
    assert instances is not None, "this process renders classes only"
    mitsuba.set_variant(job.variant)
    (folder / PARTS).mkdir(exist_ok=True)
    parent, done = os.getppid(), 0
    for subject in range(instances.total):
        if os.getppid() != parent:
            sys.exit("the parent process has ended")
        part = folder / PARTS / f"{subject:04d}.npz"
        write_progress(done, job.total, f"instance {subject + 1} of {instances.total}")
        if not part.exists():
            write_arrays(part, render_instance(job, subject))
        done += sum(1 for _ in views_of(job, subject))
    write_progress(done, job.total, "joining the instances")
    parts = [read_arrays(folder / PARTS / f"{subject:04d}.npz") for subject in range(instances.total)]
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    ceilings = joined.pop("half_psnr")
    write_arrays(folder / cache.VIEWS, joined | {"bounds": np.array([job.spec.lo, job.spec.hi])})
    shutil.rmtree(folder / PARTS)
    folders.write_truth(folder, job, {}, ceilings[np.isfinite(ceilings)].tolist())
    content = read_json(folder / cache.TRUTH)
    content[cache.INSTANCES] = {"train": instances.train, "unseen": instances.unseen, "observed": instances.observed}
    write_text(folder / cache.TRUTH, json.dumps(content, indent=1))


def views_of(job: Job, subject: int) -> Iterator[tuple[Split, Camera]]:
    """Cameras of an instance, its own ones: training and validation views, or those observed (``train``) and test views."""
    instances = job.spec.instances
    assert instances is not None
    seen = subject < instances.train
    counts: dict[Split, int] = (
        {"train": job.views.train, "val": job.views.val} if seen else {"train": instances.observed, "test": job.views.test}
    )
    rig = make_rig(job.spec.rig)
    seed = int(np.random.SeedSequence((job.seed, subject)).generate_state(1)[0])
    for split, count in counts.items():
        for camera in cameras(rig, split, count, job.size, seed):
            yield split, camera


def render_instance(job: Job, subject: int) -> dict[str, Any]:
    """Render all views of an instance: arrays of `invgraphics.scenes.npz`, and the PSNR between halves of each test view."""
    assert job.spec.instances is not None
    model = render.build(job.spec.builder, job.spec.seed + subject)
    with tempfile.TemporaryDirectory() as scratch:
        scene = stage.load(model, job.spec.depth, job.spec.background is not None, Path(scratch))
    rows: list[dict[str, Any]] = []
    for index, (split, camera) in enumerate(views_of(job, subject)):
        picture, ceiling = _picture(job, scene, camera, split, (job.seed, subject, index))
        hits = trace(scene, camera)
        rows.append(
            {
                "images": picture,
                "cam_to_world": camera.cam_to_world.numpy(),
                "focal": camera.focal.numpy(),
                "depth": hits.depth,
                "normal": hits.normal.astype(np.float16),
                "subject": np.int64(subject),
                "test": np.bool_(split == "test"),
                "val": np.bool_(split == "val"),
                "observed": np.bool_(split == "train" and subject >= job.spec.instances.train),
                "half_psnr": np.float64(ceiling),
            }
        )
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


def _picture(
    job: Job, scene: Any, camera: Camera, split: Split, stream: tuple[int, ...]
) -> tuple[UInt8[np.ndarray, "h w 4"], float]:
    """Straight display colour with alpha, and the PSNR between the halves of a test view; NaN for other views."""
    samples: int = getattr(job.samples, split)
    linear: Float[np.ndarray, "h w 4"]
    if split != "test":
        linear, ceiling = stage.render(scene, camera, samples, stream), float("nan")
    else:
        halves = [stage.render(scene, camera, samples // 2, (*stream, half)) for half in (1, 2)]
        linear, ceiling = (halves[0] + halves[1]) / 2, folders.psnr(halves[0], halves[1], job.spec.background)
    return quantise(folders.straight_srgb(linear)).numpy(), ceiling


if __name__ == "__main__":
    worker_main(main, cache.unwritable)
