"""Films of a run: around the scene, by its photographs, or of the fit itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from invgraphics.core import Camera, Quantity
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.renderers.ellipsoids import draw_ellipsoids
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import RunFolder, make_parent
from invgraphics.tools.paths import PATHS, Capture, PathName, classify_capture

FilmPath = PathName | Literal["timelapse"]
HOLD_SECONDS = 1.5
"""How long a time-lapse shows its last picture."""


@dataclass(frozen=True)
class FilmRequest:
    """What to film.

    Attributes:
        run: folder of the run.
        out: file to write, ``.mp4``.
        path: ``orbit``, ``spiral``, ``interpolate`` between photographs, or ``timelapse`` of the fit; ``None`` for the one that
            suits the capture.
        frames: pictures of a path; a time-lapse has one for each snapshot.
        rate: pictures per second.
        size: of the pictures, the longest side or (width, height); ``None`` for the run's own.
        view: test view that a time-lapse shows.
        scene: another copy of the run's scene.
    """

    run: Path
    out: Path
    path: FilmPath | None = None
    frames: int = 90
    rate: int = 15
    size: int | tuple[int, int] | None = None
    view: int = 0
    scene: str | None = None

    def __post_init__(self) -> None:
        if self.out.suffix != ".mp4":
            raise InputError(f"--out cannot be '{self.out}'.", "Expected a file name that ends in .mp4.")
        if self.frames < 1 or self.rate < 1:
            raise InputError("--frames and --fps must be at least 1.")


def film(request: FilmRequest) -> Path:
    """Render a film; returns its file.

    Raises:
        InputError: the run cannot be opened, or has no snapshots for a time-lapse, or the file cannot be written.
    """
    fitted = open_fitted(request.run, request.scene).in_its_frame()
    make_parent(request.out)
    if request.path == "timelapse":
        total, pictures = _timelapse(fitted, request)
    else:
        capture = classify_capture(fitted.scene)
        path = request.path or capture.path
        print(explanation(path, capture), file=sys.stderr)
        cameras = PATHS[path](fitted.scene, request.frames)
        request = replace(request, path=path)
        total, pictures = len(cameras), (_picture(fitted, _sized(camera, request.size)) for camera in cameras)
    with Reporter(f"{request.path} of {request.run}") as reporter:
        _write(request, _reported(pictures, total, reporter))
    return request.out


def explanation(path: str, capture: Capture) -> str:
    """Why this path, or what is wrong with it, in one line."""
    if path == capture.path:
        return f"Path: {path}, as the photographs {capture.words}."
    if path == "orbit":
        return f"Path: orbit, but the photographs {capture.words}: elsewhere nothing was fitted (--path {capture.path} suits)."
    return f"Path: {path}."


def _reported(pictures: Iterator[np.ndarray], total: int, reporter: Reporter) -> Iterator[np.ndarray]:
    for index, picture in enumerate(pictures):
        if index < total:  # a time-lapse holds its last picture
            reporter.show((index + 1) / total, f"picture {index + 1} of {total}")
        yield picture


def _timelapse(fitted: Fitted, request: FilmRequest) -> tuple[int, Iterator[np.ndarray]]:
    """Number of snapshots, and their pictures; beside each its ellipsoids, where the field is made of Gaussians."""
    snapshots = RunFolder(request.run).snapshots
    if not snapshots:
        raise InputError(f"{request.run} has no snapshots to make a time-lapse from.", "Fit with --snapshots 60, for instance.")
    views = fitted.scene.test
    if not 0 <= request.view < len(views):
        raise InputError(f"--view cannot be {request.view}.", f"Expected a test view, 0 to {len(views) - 1}.")
    camera = _sized(views[request.view].camera, request.size)

    def pictures() -> Iterator[np.ndarray]:
        picture = np.zeros((1, 1, 3), np.uint8)
        for path in snapshots:
            state = checkpoint.load(path, fitted.model.device)
            fitted.load(state)
            picture = _picture(fitted, camera)
            if Quantity.GAUSSIANS in fitted.model.field.provides:
                picture = np.concatenate([picture, _ellipsoids(fitted, camera)], axis=1)
            yield picture
        for _ in range(round(HOLD_SECONDS * request.rate)):
            yield picture

    return len(snapshots), pictures()


def _picture(fitted: Fitted, camera: Camera) -> np.ndarray:
    """8-bit display colours over the scene's background."""
    rendering = fitted.model.render(camera, normals=False)
    return display(rendering.over(fitted.scene.background), fitted.scene).numpy()


def _ellipsoids(fitted: Fitted, camera: Camera) -> np.ndarray:
    model = fitted.model
    with torch.no_grad():
        drawn = draw_ellipsoids(model.field.primitives(Quantity.GAUSSIANS, model.context()), camera.to(model.device))
    rendering = replace(drawn, rgb=drawn.rgb.cpu(), alpha=drawn.alpha.cpu())
    return display(rendering.over(fitted.scene.background), fitted.scene).numpy()


def _sized(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """The camera at another size; one number is the longest side."""
    if size is None:
        return camera
    if isinstance(size, tuple):
        return camera.resized(*size)
    scale = size / max(camera.width, camera.height)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _write(request: FilmRequest, pictures: Iterator[np.ndarray]) -> None:
    """Write an H.264 film. Its pictures need even sides: an odd one is continued by its last row or column."""
    import imageio_ffmpeg

    writer = None
    try:
        for picture in pictures:
            height, width = picture.shape[:2]
            even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                size = (even.shape[1], even.shape[0])
                writer = imageio_ffmpeg.write_frames(str(request.out), size, fps=request.rate, quality=8, macro_block_size=2)
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
    finally:
        if writer is not None:
            writer.close()
