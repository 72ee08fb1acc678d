"""Films of a run: along a camera path, or a time-lapse of the fit."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from invgraphics.core import Camera, Quantity, Rendering
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.files import replacing
from invgraphics.renderers.gaussians.ellipsoids import draw_ellipsoids
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import RunFolder, output_file
from invgraphics.tools.camera_path import CameraPath, read_camera_path
from invgraphics.tools.colorize import colorize, depth_range
from invgraphics.tools.paths import PATHS, Capture, PathName, classify_capture

FilmPath = PathName | Literal["timelapse"]
Show = Literal["prediction", "depth", "normal"]
HOLD_SECONDS = 1.5
"""How long a time-lapse shows its last picture."""
FRAMES = 90
"""Pictures of a path that has no duration of its own."""
PROBES, PROBE_SIZE = 8, 96
"""Frames, and pixels along their longer side, from which the range of depths of a film is taken."""


@dataclass(frozen=True)
class FilmRequest:
    """What to film.

    Attributes:
        run: folder of the run.
        out: file to write, ``.mp4``.
        path: ``orbit``, ``spiral``, ``interpolate`` between photographs, or ``timelapse`` of the fit; a file of a camera path;
            ``None`` for the one that suits the capture.
        frames: pictures of a path; a time-lapse has one for each snapshot. ``None`` for 90, or as many as a camera path's
            duration holds.
        rate: pictures per second.
        size: of the pictures, the longest side or (width, height), which may have another shape; ``None`` for the run's own.
        view: test view that a time-lapse shows.
        scene: another copy of the run's scene.
        show: colours, depth, or normals; a time-lapse shows colours.
    """

    run: Path
    out: Path
    path: FilmPath | Path | None = None
    frames: int | None = None
    rate: int = 15
    size: int | tuple[int, int] | None = None
    view: int = 0
    scene: str | None = None
    show: Show = "prediction"

    def __post_init__(self) -> None:
        if self.out.suffix != ".mp4":
            raise InputError(f"--out cannot be '{self.out}'.", "Expected a file name that ends in .mp4.")
        if (self.frames is not None and self.frames < 1) or self.rate < 1:
            raise InputError("--frames and --fps must be at least 1.")
        if self.path == "timelapse" and self.show != "prediction":
            raise InputError(f"--show {self.show} does not go with --path timelapse.", "A time-lapse shows colours.")


def film(request: FilmRequest) -> Path:
    """Render a film; returns its file.

    Raises:
        InputError: the run or the camera path cannot be opened, there are no snapshots for a time-lapse, or the file cannot be
            written.
    """
    saved = read_camera_path(request.path) if isinstance(request.path, Path) else None
    fitted = open_fitted(request.run, request.scene).in_its_frame()
    with output_file(request.out):
        return _film(fitted, request, saved)


def _film(fitted: Fitted, request: FilmRequest, saved: CameraPath | None) -> Path:
    if request.path == "timelapse":
        total, pictures = _timelapse(fitted, request)
    elif saved is not None:
        count, like = request.frames or saved.frame_count(request.rate), _sized(fitted.scene.test[0].camera, request.size)
        cameras = saved.cameras(fitted.scene, count, (like.width, like.height))
        total, pictures = count, _render_cameras(fitted, cameras, request)
    else:
        assert not isinstance(request.path, Path)
        capture = classify_capture(fitted.scene)
        path = request.path or capture.path
        print(path_explanation(path, capture), file=sys.stderr)
        request = replace(request, path=path)
        total = request.frames or FRAMES
        pictures = _render_cameras(
            fitted, [_sized(camera, request.size) for camera in PATHS[path](fitted.scene, total)], request
        )
    with Reporter(f"{request.path} of {request.run}") as reporter, FilmWriter(request.out, request.rate) as writer:
        for picture in _with_progress(pictures, total, reporter):
            writer.add(picture)
    return request.out


def path_explanation(path: str, capture: Capture) -> str:
    """Explain in one line why the path was chosen, or why it does not suit the capture."""
    if path == capture.path:
        return f"Path: {path}, as the photographs {capture.words}."
    if path == "orbit":
        return f"Path: orbit, but the photographs {capture.words}: elsewhere nothing was fitted (--path {capture.path} suits)."
    return f"Path: {path}."


def _with_progress(pictures: Iterator[np.ndarray], total: int, reporter: Reporter) -> Iterator[np.ndarray]:
    for index, picture in enumerate(pictures):
        if index < total:  # a time-lapse holds its last picture
            reporter.show((index + 1) / total, f"picture {index + 1} of {total}")
        yield picture


def _timelapse(fitted: Fitted, request: FilmRequest) -> tuple[int, Iterator[np.ndarray]]:
    """Render all snapshots; returns their number and pictures, side by side with ellipsoids for Gaussian fields."""
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


def _render_cameras(fitted: Fitted, cameras: Sequence[Camera], request: FilmRequest) -> Iterator[np.ndarray]:
    """Render the pictures of a path, depth in one shared range, which is printed."""
    geometry, span = request.show == "normal", None

    def render(camera: Camera) -> Rendering:
        return fitted.model.render(camera, normals=geometry)

    if request.show == "depth":
        chosen = [cameras[round(index)] for index in np.linspace(0, len(cameras) - 1, min(PROBES, len(cameras)))]
        small = [_sized(camera, min(PROBE_SIZE, max(camera.width, camera.height))) for camera in chosen]
        span = depth_range([render(camera) for camera in small], [fitted.scene] * len(small))
    for index, camera in enumerate(cameras):
        seen = colorize(request.show, [render(camera)], [fitted.scene], [None], span)
        if index == 0 and seen.legend:
            print(f"{request.show.capitalize()}: {seen.legend}.", file=sys.stderr)
        yield seen.pictures[0]


def _picture(fitted: Fitted, camera: Camera) -> np.ndarray:
    """Render a camera to 8-bit display colours over the scene's background."""
    rendering = fitted.model.render(camera, normals=False)
    return display(rendering.over(fitted.scene.background), fitted.scene).numpy()


def _ellipsoids(fitted: Fitted, camera: Camera) -> np.ndarray:
    drawn = draw_ellipsoids(fitted.model.gaussians(), camera.to(fitted.model.device))
    rendering = replace(drawn, rgb=drawn.rgb.cpu(), alpha=drawn.alpha.cpu())
    return display(rendering.over(fitted.scene.background), fitted.scene).numpy()


def _sized(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """Resize a camera; one number is the longest side in pixels.

    Pixels keep their shape: a picture of another shape than the photograph's shows all that this does in its middle, and more
    along the side that is longer beside the other.
    """
    if size is None:
        return camera
    if isinstance(size, int):
        scale = size / max(camera.width, camera.height)
        return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    new, old = camera.focal.new_tensor(size), camera.focal.new_tensor([camera.width, camera.height])
    scale = (new / old).min()
    centre = new / 2 + (camera.principal_point - old / 2) * scale
    return replace(camera, focal=camera.focal * scale, principal_point=centre, width=size[0], height=size[1])


class FilmWriter:
    """Writer of an H.264 film; a context manager after which the file is there whole, or, after an exception, as it was.

    Pictures need even sides: an odd one is continued by its last row or column.

    Args:
        out: file to write.
        rate: pictures per second.
    """

    def __init__(self, out: Path, rate: int) -> None:
        self._out, self._rate = out, rate
        self._writer: Any = None
        self._file = ExitStack()
        self._temporary = out

    def add(self, picture: np.ndarray) -> None:
        """Append an 8-bit picture (h, w, 3); all have the first one's size."""
        import imageio_ffmpeg

        height, width = picture.shape[:2]
        even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if self._writer is None:
            size = (even.shape[1], even.shape[0])
            to = {"quality": 8, "macro_block_size": 2, "output_params": ["-f", "mp4"], "ffmpeg_log_level": "fatal"}
            self._writer = imageio_ffmpeg.write_frames(str(self._temporary), size, fps=self._rate, **to)
            self._writer.send(None)
        self._writer.send(np.ascontiguousarray(even))

    def __enter__(self) -> Self:
        self._temporary = self._file.enter_context(replacing(self._out))
        self._file.push(self._close)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.__exit__(kind, error, trace)

    def _close(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End ffmpeg, which does not say so where it could not write all."""
        if self._writer is not None:
            self._writer.close()
        interrupted = error is not None and not isinstance(error, OSError)  # an OSError is ffmpeg's end, seen from here
        if not interrupted and not _is_whole(self._temporary):
            sentence = f"'{self._out}' cannot be written: ffmpeg did not finish it."
            raise InputError(sentence, "The disk may be full: free some space there.") from error


def _is_whole(film: Path) -> bool:
    """Whether an MP4 file's boxes reach exactly to its end, and its index, which is written last, is among them."""
    if not film.is_file():
        return False
    place, names, end = 0, set(), film.stat().st_size
    with film.open("rb") as file:
        while place < end:
            file.seek(place)
            size, name = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
            size = struct.unpack(">Q", file.read(8).ljust(8, b"\0"))[0] if size == 1 else size
            if size < 8:
                return False
            names.add(name)
            place += size
    return place == end and b"moov" in names
