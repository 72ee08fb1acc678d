"""Export of a camera path as a film of what a browser shows."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from invgraphics.core import Camera, Rendering
from invgraphics.tools.colorize import colorize, depth_range
from invgraphics.tools.film import PROBE_SIZE, PROBES, FilmWriter
from invgraphics.viewer.cameras import limit_size
from invgraphics.viewer.crop import CropBox
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.render_thread import Task

RATE = 24
"""Usual frames per second of an exported film."""
Shape = Literal["photograph", "window"]
SHAPES: tuple[Shape, ...] = ("photograph", "window")


@dataclass(frozen=True)
class FilmLook:
    """What the frames of a film show.

    Attributes:
        output: prediction, depth or normal.
        background: behind predictions, in the scene's colour space; ``None`` for the scene's own.
        crop: in the run's local frame.
        rate: frames per second.
    """

    output: str
    background: tuple[float, float, float] | None
    crop: CropBox | None
    rate: int = RATE


def film_size(shape: Shape, run: LoadedRun, window: tuple[int, int], max_size: int) -> tuple[int, int]:
    """(width, height) of a film of this shape, at most ``max_size`` along the longer side and as large as its model."""
    if shape == "photograph":
        camera = limit_size(run.scene.test[0].camera, max_size)
        return camera.width, camera.height
    scale = min(1.0, max_size / max(window))
    return max(1, round(window[0] * scale)), max(1, round(window[1] * scale))


def export_film(
    run: LoadedRun,
    cameras: Sequence[Camera],
    look: FilmLook,
    on_progress: Callable[[str], None],
    on_film: Callable[[bytes, str], None],
) -> Task:
    """Task for the render thread that renders a film, one frame per slice; cancelled, it leaves no file.

    Args:
        run: what is rendered.
        cameras: in the run's local frame, all of one size.
        look: of the frames.
        on_progress: called with a line about the progress, for each second of film.
        on_film: called with the MP4 file's content and a line about it.
    """
    count = len(cameras)

    def render(camera: Camera) -> Rendering:
        return run.render(camera, look.output == "normal", look.crop)

    scene, span = run.scene, None
    if look.output == "prediction" and look.background is not None:
        scene = replace(scene, background=torch.tensor(look.background))
    if look.output == "depth":
        probes = []
        for index in np.linspace(0, len(cameras) - 1, min(PROBES, len(cameras))):
            probes.append(render(limit_size(cameras[round(index)], PROBE_SIZE)))
            yield 0.0
        span = depth_range(probes, [scene] * len(probes))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "film.mp4"
        with FilmWriter(out, look.rate) as writer:
            for index, camera in enumerate(cameras):
                writer.add(colorize(look.output, [render(camera)], [scene], [None], span).pictures[0])
                if index % look.rate == 0:
                    on_progress(f"Exporting: frame {index + 1} of {count}")
                yield 0.0
        frames = f"{count} frame{'s' * (count != 1)}"
        on_film(out.read_bytes(), f"Film of {frames}: the {look.output} of {run.name}. Sent to the browser.")
