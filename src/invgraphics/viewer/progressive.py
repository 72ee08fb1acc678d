"""Progressive rendering of a window: coarse while the camera moves, refined in strips at rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch

from invgraphics.core import Camera, Rendering, View
from invgraphics.metrics.protocols import PROTOCOLS, score
from invgraphics.tools.colorize import Picture, colorize, resize_image, true_image
from invgraphics.viewer.cameras import LetterboxedView, ViewerCamera, limit_size, rescale, subregion
from invgraphics.viewer.crop import CropBox
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.render_thread import Task
from invgraphics.viewer.resolution import SETTLE_SECONDS, AdaptiveResolution
from invgraphics.viewer.window import crop_columns, letterboxed, side_by_side_image

Layout = Literal["first", "second", "split", "side by side"]
LAYOUTS: tuple[Layout, ...] = ("split", "side by side", "first", "second")


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Camera, output and layout of a frame.

    Attributes:
        camera: of the window, in the first run's local frame.
        window: (width, height) in pixels.
        output: one of `colorize.OUTPUTS`.
        view: the photograph that the camera is at; ``None`` for a free camera.
        layout: arrangement of the runs.
        split: share of the window's width of the first run in a split layout.
        max_size: limit of the longer side, pixels.
        skip_coarse: start at full size, because an image from here is on screen already.
        background: behind predictions, in the scene's colour space; ``None`` for the scene's own.
        crop: box in the first run's local frame outside which nothing is rendered.
    """

    camera: ViewerCamera
    window: tuple[int, int]
    output: str = "prediction"
    view: View | None = None
    layout: Layout = "first"
    split: float = 0.5
    max_size: int = 800
    skip_coarse: bool = False
    background: tuple[float, float, float] | None = None
    crop: CropBox | None = None


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """A rendered image of the window.

    Attributes:
        image: 8-bit colours.
        picture: the same without the bars beside a photograph.
        size: rendered (width, height).
        seconds: render time.
        final: whether this is the finest level.
        output: what is shown: prediction, truth, error, depth and so on.
        legend: of the colours.
        psnr: of each run against the photograph in dB, where it is rendered whole and at full size; else empty.
    """

    image: Picture
    picture: Picture
    size: tuple[int, int]
    seconds: float
    final: bool
    output: str
    legend: str = ""
    psnr: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class _Panel:
    """A part of the window: a run, the camera of its whole image, and its visible columns."""

    run: LoadedRun
    camera: Camera
    columns: tuple[int, int]

    @property
    def whole(self) -> bool:
        return self.columns == (0, self.camera.width)

    @property
    def pixels(self) -> tuple[int, int]:
        """Rendered (width, height): the whole image unless pixels are independent."""
        return (self.columns[1] - self.columns[0] if self.run.independent_pixels else self.camera.width), self.camera.height

    def at(self, scale: float) -> _Panel:
        """The panel at another scale, at least one column wide."""
        camera = rescale(self.camera, scale)
        first, last = (round(column * camera.width / self.camera.width) for column in self.columns)
        first = min(first, camera.width - 1)
        return _Panel(self.run, camera, (first, max(last, first + 1)))


@dataclass(eq=False)
class _Side:
    """Refinement state of one panel.

    Attributes:
        panel: at full size.
        scales: of the levels still to render, from coarse to fine.
        spent: total render time, seconds.
        latest: the finest rendering so far, its panel and its render time.
        task: the level in progress.
        began: ``spent`` at its start.
    """

    panel: _Panel
    scales: list[float]
    spent: float = 0.0
    latest: tuple[_Panel, Rendering, float] | None = None
    task: Generator[float, None, Rendering] | None = None
    began: float = 0.0


class ProgressiveRenderer:
    """Coarse-to-fine renderer of one or two runs; each run refines its panel at its own speed.

    Args:
        runs: one or two; cameras are in the first one's local frame.
        clock: seconds; render times are differences of it.
    """

    def __init__(self, runs: Sequence[LoadedRun], clock: Callable[[], float] = time.perf_counter) -> None:
        self.runs = tuple(runs)
        self._clock = clock
        self.resolutions = {run: AdaptiveResolution() for run in self.runs}

    def render(self, request: RenderRequest, on_frame: Callable[[ViewerFrame], None]) -> Task:
        """Task for the render thread that calls ``on_frame`` with frames from coarse to fine."""
        side_by_side = request.layout == "side by side" and request.output != "truth"
        window = (max(1, request.window[0] // (1 + side_by_side)), max(1, request.window[1]))
        letterbox = None
        if request.view is None:
            viewer_camera = replace(request.camera, aspect=request.camera.aspect / (1 + side_by_side))
            camera = limit_size(viewer_camera.pinhole(*window), request.max_size)
        else:
            letterbox = LetterboxedView.fit(
                limit_size(request.view.camera, request.max_size), request.camera.aspect / (1 + side_by_side)
            )
            camera = letterbox.camera
        if request.output == "truth" and request.view is not None:
            on_frame(self._truth(request.view, letterbox))
            return
        panels = self._panels(request, camera, letterbox)
        sides = [
            _Side(each, self.resolutions[each.run].pyramid_scales(*each.pixels, request.skip_coarse, len(panels)))
            for each in panels
        ]
        moving, began = not request.skip_coarse, self._clock()
        for side in sides:
            while not self._advance(side, request, untiled=moving):
                yield 0.0
        on_frame(self._compose(request, sides, letterbox))
        if moving:
            self._update_resolutions(sides, self._clock() - began)
        yield SETTLE_SECONDS if moving else 0.0
        while waiting := [side for side in sides if side.scales]:
            # The side with the least time so far: a fast run is fine long before a slow one.
            if self._advance(min(waiting, key=lambda side: side.spent), request, untiled=False):
                on_frame(self._compose(request, sides, letterbox))
            yield 0.0

    def _update_resolutions(self, sides: Sequence[_Side], seconds: float) -> None:
        """Adapt the resolution of each side to a frame that took ``seconds``; composing and encoding are shared equally."""
        shared = (seconds - sum(side.spent for side in sides)) / len(sides)
        for side in sides:
            assert side.latest is not None
            _, rendering, took = side.latest
            self.resolutions[side.panel.run].update(rendering.alpha.numel(), took + shared)

    def _advance(self, side: _Side, request: RenderRequest, untiled: bool) -> bool:
        """Render the next strip of a side's level; whether that has finished it."""
        panel, began, finished = side.panel.at(side.scales[0]), self._clock(), None
        if side.task is None:
            side.task, side.began = self._render(panel, request, untiled), side.spent
        try:
            next(side.task)
        except StopIteration as stop:
            finished = stop.value
        side.spent += self._clock() - began
        if finished is None:
            return False
        took = side.spent - side.began
        side.latest, side.task = (panel, finished, took), None
        side.scales.pop(0)
        return True

    def _panels(self, request: RenderRequest, camera: Camera, letterbox: LetterboxedView | None) -> list[_Panel]:
        whole = (0, camera.width)
        first, second = self.runs[0], self.runs[-1]
        if request.layout == "side by side":
            return [_Panel(first, camera, whole), _Panel(second, camera, whole)]
        if request.layout != "split":
            return [_Panel(second if request.layout == "second" else first, camera, whole)]
        cut = request.split * camera.width
        if letterbox is not None:
            cut = (request.split * letterbox.width - letterbox.left) * camera.width / letterbox.camera.width
        column = min(max(round(cut), 0), camera.width)
        panels = [_Panel(first, camera, (0, column)), _Panel(second, camera, (column, camera.width))]
        return [panel for panel in panels if panel.columns[0] < panel.columns[1]]

    def _render(self, panel: _Panel, request: RenderRequest, untiled: bool) -> Generator[float, None, Rendering]:
        run, columns, geometry = panel.run, panel.columns, request.output == "normal"
        crop = None if request.crop is None else run.crop_to_local(request.crop, self.runs[0].scene)
        camera = run.to_local(panel.camera, self.runs[0].scene)
        if not run.independent_pixels:
            # A splat's footprint depends on its distance to the image's border, so tiles would not match.
            picture = run.render(camera, geometry, crop)
            return picture if panel.whole else crop_columns(picture, columns)
        # Strips do not adapt the resolution: one of empty background is fast, and the next movement would be slow.
        rows = camera.height if untiled else self.resolutions[run].strip_rows(columns[1] - columns[0])
        parts = []
        for top in range(0, camera.height, rows):
            if parts:
                yield 0.0
            strip = subregion(camera, columns, (top, min(top + rows, camera.height)))
            parts.append(run.render(strip, geometry, crop))
        return Rendering.cat(parts)

    def _compose(self, request: RenderRequest, sides: Sequence[_Side], letterbox: LetterboxedView | None) -> ViewerFrame:
        """Colorize the latest rendering of all sides with one scale, upsample to the finest, and assemble the window."""
        latest = [side.latest for side in sides if side.latest is not None]
        panels, renderings = [panel for panel, _, _ in latest], [rendering for _, rendering, _ in latest]
        finest = max((panel.camera for panel in panels), key=lambda camera: camera.width)
        truths: list[Picture | None] = [None] * len(panels)
        if request.output == "error" and request.view is not None:
            scene, sizes = self.runs[0].scene, [(panel.camera.width, panel.camera.height) for panel in panels]
            truths = [
                true_image(request.view, scene, size)[:, slice(*p.columns)] for p, size in zip(panels, sizes, strict=True)
            ]
        scenes = [panel.run.scene for panel in panels]
        if request.background is not None and request.output == "prediction":
            scenes = [replace(scene, background=torch.tensor(request.background)) for scene in scenes]
        seen = colorize(request.output, renderings, scenes, truths)
        columns = [side.panel.at(finest.width / side.panel.camera.width).columns for side in sides]
        pictures = [
            resize_image(picture, (last - first, finest.height))
            for picture, (first, last) in zip(seen.pictures, columns, strict=True)
        ]
        picture = side_by_side_image(pictures)
        if request.layout == "side by side":
            image = side_by_side_image([letterboxed(each, letterbox) for each in pictures])
        else:
            image = letterboxed(picture, letterbox)
        return ViewerFrame(
            image,
            picture,
            (finest.width, finest.height),
            sum(took for _, _, took in latest),
            not any(side.scales for side in sides),
            request.output,
            seen.legend,
            self._psnr(request, panels, renderings),
        )

    def _psnr(self, request: RenderRequest, panels: Sequence[_Panel], renderings: Sequence[Rendering]) -> tuple[float, ...]:
        view = request.view
        if (
            view is None
            or request.crop is not None
            or request.output not in ("prediction", "error")
            or not all(panel.whole for panel in panels)
        ):
            return ()
        if any(rendering.alpha.shape != view.image.shape[:2] for rendering in renderings):
            return ()
        scores = [score(each, view, self.runs[0].scene, PROTOCOLS["default"], only=["psnr"]) for each in renderings]
        return tuple(found.values["psnr"] for found in scores if "psnr" in found.values)

    def _truth(self, view: View, letterbox: LetterboxedView | None) -> ViewerFrame:
        size = (
            (view.camera.width, view.camera.height) if letterbox is None else (letterbox.camera.width, letterbox.camera.height)
        )
        picture = true_image(view, self.runs[0].scene, size)
        return ViewerFrame(letterboxed(picture, letterbox), picture, size, 0.0, True, "truth", f"the photograph {view.name}")
