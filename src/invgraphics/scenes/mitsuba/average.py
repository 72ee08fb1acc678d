"""Averaging process: smaller pictures of a scene as area averages of a larger cached rendering.

A pixel's value is the mean radiance over its area (the film's box filter), so averages of linear, premultiplied pixels are what
a rendering at the smaller size converges to, with all their samples. Depth and normals belong to pixel centres and cannot be
averaged: they are traced at the new size, one ray per pixel.

``python -m invgraphics.scenes.mitsuba.average FOLDER`` does the job of ``FOLDER/job.json``, as the rendering process does.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from invgraphics.arrays import read_arrays
from invgraphics.core import Camera
from invgraphics.files import write_text
from invgraphics.scenes.mitsuba import cache, render, stage
from invgraphics.scenes.mitsuba import folder as folders
from invgraphics.scenes.mitsuba.gbuffer import trace, trace_fog
from invgraphics.scenes.mitsuba.job import Job, Source
from invgraphics.scenes.mitsuba.rig import SPLITS, Split, cameras, make_rig
from invgraphics.scenes.pictures.resize import area_resize
from invgraphics.scenes.process import worker_main, write_progress
from invgraphics.tables import read_json


def main(folder: Path) -> None:
    """Average the views that are missing in ``folder``, trace their geometry, and write what depends on all views."""
    import mitsuba

    job = Job.from_json((folder / cache.REQUEST).read_text(encoding="utf-8"))
    assert job.source is not None, "this process averages only"
    mitsuba.set_variant(job.variant)
    large = cache.root() / job.rendered_source().folder_name
    model = render.build(job.spec.builder, job.spec.seed)
    with tempfile.TemporaryDirectory() as scratch:
        scene = None if model.fog else stage.load(model, job.spec.depth, job.spec.background is not None, Path(scratch))
    parent = os.getppid()
    for done, (split, index, camera) in enumerate(_views(job)):
        if os.getppid() != parent:
            sys.exit("the parent process has ended")
        write_progress(done, job.total, f"{split} {index:04d}")
        if not folders.view_paths(folder, split, index)[1].exists():
            gbuffer = trace_fog(model.fog, camera) if model.fog else trace(scene, camera)
            linear, half_psnr = mean_picture(folders.view_paths(large, split, index)[1], job)
            folders.write_view(folder, split, index, linear, gbuffer, half_psnr)
    render.main(folder)  # finds every view there, and writes the rest
    _declare(folder, job.source)


def _views(job: Job) -> Iterator[tuple[Split, int, Camera]]:
    rig = make_rig(job.spec.rig)
    counts: dict[Split, int] = {"train": job.views.train, "val": job.views.val, "test": job.views.test}
    for split in SPLITS:
        for index, camera in enumerate(cameras(rig, split, counts[split], job.size, job.seed)):
            yield split, index, camera


def mean_picture(arrays: Path, job: Job) -> tuple[Float[np.ndarray, "h w 4"], float]:
    """Average a view's linear RGBA to the job's size; also the PSNR in dB between halves of its samples, first order."""
    assert job.source is not None
    table = read_arrays(arrays)
    linear, half_psnr = table["linear"].astype(np.float64), float(table["half_psnr"])
    gain = 10 * math.log10(math.prod(job.source.size) / math.prod(job.size))  # noise of pixels is independent: variances divide
    return area_resize(linear, *job.size).astype(np.float32), half_psnr + gain


def _declare(folder: Path, source: Source) -> None:
    """Record the averaged source in ``truth.json``."""
    path = folder / cache.TRUTH
    samples = {split: getattr(source.samples, split) for split in SPLITS}
    content = read_json(path)
    content[cache.AVERAGED_FROM] = {"size": list(source.size), "samples_per_pixel": samples}
    write_text(path, json.dumps(content, indent=1))


if __name__ == "__main__":
    worker_main(main, cache.unwritable)
