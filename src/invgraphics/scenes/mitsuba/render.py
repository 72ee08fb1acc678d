"""The rendering process: ``python -m invgraphics.scenes.mitsuba.render FOLDER`` renders the job of ``FOLDER/job.json``.

It runs apart from the caller because a bad LLVM aborts the process that uses it. It reports on its standard output, a line per
view: ``progress DONE TOTAL WHAT``. Views that an interrupted process has left are kept.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from invgraphics.arrays import read_arrays
from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.files import write_arrays
from invgraphics.scenes.mitsuba import folder as folders
from invgraphics.scenes.mitsuba import ply, stage
from invgraphics.scenes.mitsuba.build import BUILDERS
from invgraphics.scenes.mitsuba.build.mesh import merge, sphere
from invgraphics.scenes.mitsuba.build.model import Model
from invgraphics.scenes.mitsuba.cache import REQUEST, unwritable
from invgraphics.scenes.mitsuba.gbuffer import GBuffer, sample_points, trace, trace_fog
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.rig import SPLITS, Split, cameras, make_rig
from invgraphics.scenes.process import worker_main, write_progress

POINTS = 20_000


def main(folder: Path) -> None:
    """Render what is missing in ``folder``, then write what depends on all views."""
    import mitsuba

    job = Job.from_json((folder / REQUEST).read_text(encoding="utf-8"))
    mitsuba.set_variant(job.variant)
    rig = make_rig(job.spec.rig)
    counts: dict[Split, int] = {"train": job.views.train, "val": job.views.val, "test": job.views.test}
    views: dict[Split, tuple[Camera, ...]] = {split: cameras(rig, split, counts[split], job.size, job.seed) for split in SPLITS}
    model = build(job.spec.builder, job.spec.seed)
    with tempfile.TemporaryDirectory() as scratch:
        scene = stage.load(model, job.spec.depth, job.spec.background is not None, Path(scratch))
    done, parent = 0, os.getppid()
    for split in SPLITS:
        for index, camera in enumerate(views[split]):
            if os.getppid() != parent:
                sys.exit("the process that started this rendering has ended")  # what is done stays, and is gone on with
            write_progress(done, job.total, f"{split} {index:04d}")
            if not folders.view_paths(folder, split, index)[1].exists():
                _render_view(job, scene, model, folder, (split, index, camera))
            done += 1
    write_progress(done, job.total, "points and mesh")
    _finish(job, model, folder, views)


def build(builder: str, seed: int) -> Model:
    """Make a registered model.

    Raises:
        InputError: there is no such builder.
    """
    if builder not in BUILDERS:
        raise InputError(f"There is no builder '{builder}'.", f"Known builders: {', '.join(BUILDERS)}.")
    module, _, function = BUILDERS[builder].partition(":")
    return getattr(importlib.import_module(module), function)(seed)


def _render_view(job: Job, scene: Any, model: Model, folder: Path, view: tuple[Split, int, Camera]) -> None:
    split, index, camera = view
    samples: int = getattr(job.samples, split)
    stream = (job.seed, SPLITS.index(split), index)
    if split == "test":
        halves = [stage.render(scene, camera, samples // 2, (*stream, half)) for half in (1, 2)]
        linear, half_psnr = (halves[0] + halves[1]) / 2, folders.psnr(halves[0], halves[1], job.spec.background)
    else:
        linear, half_psnr = stage.render(scene, camera, samples, (*stream, 0)), float("nan")
    gbuffer = trace_fog(model.fog, camera) if model.fog else trace(scene, camera)
    _check_bounds(job, gbuffer)
    folders.write_view(folder, split, index, linear, gbuffer, half_psnr)


def _check_bounds(job: Job, gbuffer: GBuffer) -> None:
    seen = gbuffer.position[np.isfinite(gbuffer.depth)]
    lo, hi = np.array(job.spec.lo), np.array(job.spec.hi)
    if len(seen) and ((seen < lo - 1e-4).any() or (seen > hi + 1e-4).any()):
        low, high = (corner.astype(float).round(3).tolist() for corner in (seen.min(axis=0), seen.max(axis=0)))
        raise InputError(f"Surfaces from {low} to {high} leave the scene's box.", "Widen 'lo' and 'hi' in its scene.toml.")


def _finish(job: Job, model: Model, folder: Path, views: dict[Split, tuple[Camera, ...]]) -> None:
    if not model.fog:
        _write_points(job, folder, views["train"])
        mesh = merge([part.mesh for part in model.parts] + [sphere(ball.centre, ball.radius) for ball in model.balls])
        ply.write(folder / "mesh.ply", *ply.weld(mesh.vertices, mesh.faces))
    half_psnr = []
    for split in SPLITS:
        if views[split]:
            folders.write_transforms(folder, split, views[split])
    for index in range(job.views.test):
        half_psnr.append(float(read_arrays(folders.view_paths(folder, "test", index)[1])["half_psnr"]))
    folders.write_truth(folder, job, views, half_psnr)


def _write_points(job: Job, folder: Path, train: tuple[Camera, ...]) -> None:
    """Write a random choice of the points that the training views see, one view in memory at a time."""
    paths = [folders.view_paths(folder, "train", index)[1] for index in range(len(train))]
    counts = [int(np.isfinite(read_arrays(path)["depth"]).sum()) for path in paths]
    chosen = sample_points(counts, POINTS, job.seed)
    position, rgb = (np.zeros((min(sum(counts), POINTS), 3), np.float32) for _ in range(2))
    for path, camera, (places, points) in zip(paths, train, chosen, strict=True):
        arrays, rays = read_arrays(path), camera.rays()
        depth = arrays["depth"].reshape(-1)
        pixel = np.flatnonzero(np.isfinite(depth))[points]
        position[places] = rays.origins.numpy()[pixel] + depth[pixel, None] * rays.directions.numpy()[pixel]
        rgb[places] = folders.straight_srgb(arrays["linear"])[..., :3].numpy().reshape(-1, 3)[pixel]
    write_arrays(folder / "points.npz", {"position": position, "rgb": rgb})


if __name__ == "__main__":
    worker_main(main, unwritable)
