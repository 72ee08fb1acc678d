"""From what a browser asks for to pictures of its window: coarse first, finer when the camera rests, in pieces."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray

from invgraphics.core import Camera, Rendering, View
from invgraphics.metrics.protocols import PROTOCOLS, score
from invgraphics.viewer.cameras import Gaze, Mount, limited, part, scaled
from invgraphics.viewer.colouring import EMPTY, Picture, coloured, framed, photograph, resized
from invgraphics.viewer.pace import REST, Pace
from invgraphics.viewer.subject import Subject
from invgraphics.viewer.worker import Job

Layout = Literal["first", "second", "split", "side by side"]
LAYOUTS: tuple[Layout, ...] = ("split", "side by side", "first", "second")


@dataclass(frozen=True, eq=False)
class Order:
    """What a browser wants to see.

    Attributes:
        gaze: its camera, in the first run's local frame.
        window: its size, (width, height) in pixels.
        shown: one of `colouring.SHOWN`.
        view: the photograph whose camera the browser stands at; ``None`` for anywhere else.
        layout: which runs, and where.
        share: of the window's width that the first run has in a split one.
        longest: most pixels along a picture's longest side.
        resting: whether there is a picture from here already, so that no coarse one is needed.
        background: behind predictions, in the scene's colour space; ``None`` for the scene's own.
    """

    gaze: Gaze
    window: tuple[int, int]
    shown: str = "prediction"
    view: View | None = None
    layout: Layout = "first"
    share: float = 0.5
    longest: int = 800
    resting: bool = False
    background: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Painted:
    """A picture of the window.

    Attributes:
        picture: its pixels.
        size: of what was rendered, (width, height).
        seconds: that rendering took.
        finest: whether no finer one will come.
        legend: what the colours mean.
        psnr: in dB against the photograph, one for each run whose view is shown whole and at full size; else empty.
    """

    picture: Picture
    size: tuple[int, int]
    seconds: float
    finest: bool
    legend: str = ""
    psnr: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class _Panel:
    """A part of the window: a run, the camera of its whole picture, and the columns of it that are shown."""

    subject: Subject
    camera: Camera
    columns: tuple[int, int]

    @property
    def whole(self) -> bool:
        return self.columns == (0, self.camera.width)

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of what has to be rendered; of splats that is the whole picture."""
        return (self.columns[1] - self.columns[0] if self.subject.by_rays else self.camera.width), self.camera.height

    def at(self, scale: float) -> _Panel:
        """The same part of a smaller picture, at least a column of it."""
        camera = scaled(self.camera, scale)
        first, last = (round(column * camera.width / self.camera.width) for column in self.columns)
        first = min(first, camera.width - 1)
        return _Panel(self.subject, camera, (first, max(last, first + 1)))


@dataclass(eq=False)
class _Side:
    """How far the pictures of one panel are.

    Attributes:
        panel: at full size.
        scales: of the pictures that are still to come, from coarse to fine.
        spent: seconds that have gone into this side.
        latest: the finest picture so far, its panel and the seconds it took.
        job: the picture that is being made.
    """

    panel: _Panel
    scales: list[float]
    spent: float = 0.0
    latest: tuple[_Panel, Rendering, float] | None = None
    job: Generator[float, None, Rendering] | None = None
    began: float = 0.0


class Painter:
    """Paints orders with one or two runs; each refines its part of the window at its own speed.

    Args:
        subjects: the runs; cameras are in the first one's local frame.
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        self.subjects = tuple(subjects)
        self.paces = {subject: Pace() for subject in self.subjects}

    def paint(self, order: Order, deliver: Callable[[Painted], None]) -> Job:
        """Work for the rendering thread that delivers pictures from coarse to fine."""
        side_by_side = order.layout == "side by side" and order.shown != "truth"
        window = (max(1, order.window[0] // (1 + side_by_side)), max(1, order.window[1]))
        mount = None
        if order.view is None:
            gaze = replace(order.gaze, aspect=order.gaze.aspect / (1 + side_by_side))
            camera = limited(gaze.camera(*window), order.longest)
        else:
            mount = Mount.of(limited(order.view.camera, order.longest), order.gaze.aspect / (1 + side_by_side))
            camera = mount.camera
        if order.shown == "truth" and order.view is not None:
            deliver(self._truth(order.view, mount))
            return
        panels = self._panels(order, camera, mount)
        sides = [_Side(each, self.paces[each.subject].scales(*each.pixels, order.resting, len(panels))) for each in panels]
        moving = not order.resting
        for side in sides:
            while not self._advance(side, order, in_one_piece=moving):
                yield 0.0
        deliver(self._compose(order, sides, mount))
        yield REST if moving else 0.0
        while waiting := [side for side in sides if side.scales]:
            # The side that has had least time: a fast run is fine long before a slow one, whose pieces come between.
            if self._advance(min(waiting, key=lambda side: side.spent), order, in_one_piece=False):
                deliver(self._compose(order, sides, mount))
            yield 0.0

    def _advance(self, side: _Side, order: Order, in_one_piece: bool) -> bool:
        """Do the next piece of a side's picture; whether that has finished it."""
        panel, began, finished = side.panel.at(side.scales[0]), time.perf_counter(), None
        if side.job is None:
            side.job, side.began = self._render(panel, order.shown == "normal", in_one_piece), side.spent
        try:
            next(side.job)
        except StopIteration as stop:
            finished = stop.value
        side.spent += time.perf_counter() - began
        if finished is None:
            return False
        took = side.spent - side.began
        if in_one_piece:
            self.paces[panel.subject].learn(finished.alpha.numel(), took)
        side.latest, side.job = (panel, finished, took), None
        side.scales.pop(0)
        return True

    def _panels(self, order: Order, camera: Camera, mount: Mount | None) -> list[_Panel]:
        whole = (0, camera.width)
        first, second = self.subjects[0], self.subjects[-1]
        if order.layout == "side by side":
            return [_Panel(first, camera, whole), _Panel(second, camera, whole)]
        if order.layout != "split":
            return [_Panel(second if order.layout == "second" else first, camera, whole)]
        cut = order.share * camera.width
        if mount is not None:
            cut = (order.share * mount.width - mount.left) * camera.width / mount.camera.width
        column = min(max(round(cut), 0), camera.width)
        panels = [_Panel(first, camera, (0, column)), _Panel(second, camera, (column, camera.width))]
        return [panel for panel in panels if panel.columns[0] < panel.columns[1]]

    def _render(self, panel: _Panel, geometry: bool, in_one_piece: bool) -> Generator[float, None, Rendering]:
        subject, columns = panel.subject, panel.columns
        camera = subject.placed(panel.camera, self.subjects[0].scene)
        if not subject.by_rays:
            # A splat's footprint depends on how far beyond the picture it lies, so parts would not fit together.
            picture = subject.render(camera, geometry)
            return picture if panel.whole else _columns(picture, columns)
        pace = self.paces[subject]
        rows = camera.height if in_one_piece else pace.rows(columns[1] - columns[0])
        parts = []
        for top in range(0, camera.height, rows):
            if parts:
                yield 0.0
            strip = part(camera, columns, (top, min(top + rows, camera.height)))
            began = time.perf_counter()
            parts.append(subject.render(strip, geometry))
            if not in_one_piece and strip.height == rows:
                pace.learn(strip.width * rows, time.perf_counter() - began)
        return Rendering.cat(parts)

    def _compose(self, order: Order, sides: Sequence[_Side], mount: Mount | None) -> Painted:
        """Colour the latest pictures of all sides alike, at the size of the finest, and put them into the window."""
        latest = [side.latest for side in sides if side.latest is not None]
        panels, renderings = [panel for panel, _, _ in latest], [rendering for _, rendering, _ in latest]
        finest = max((panel.camera for panel in panels), key=lambda camera: camera.width)
        truths: list[Picture | None] = [None] * len(panels)
        if order.shown == "error" and order.view is not None:
            scene, sizes = self.subjects[0].scene, [(panel.camera.width, panel.camera.height) for panel in panels]
            truths = [photograph(order.view, scene, size)[:, slice(*p.columns)] for p, size in zip(panels, sizes, strict=True)]
        scenes = [panel.subject.scene for panel in panels]
        if order.background is not None and order.shown == "prediction":
            scenes = [replace(scene, background=torch.tensor(order.background)) for scene in scenes]
        seen = coloured(order.shown, renderings, scenes, truths)
        columns = [side.panel.at(finest.width / side.panel.camera.width).columns for side in sides]
        pictures = [
            resized(picture, (last - first, finest.height))
            for picture, (first, last) in zip(seen.pictures, columns, strict=True)
        ]
        if order.layout == "side by side":
            picture = _beside([_mounted(picture, mount) for picture in pictures])
        else:
            picture = _mounted(_beside(pictures), mount)
        return Painted(
            picture,
            (finest.width, finest.height),
            sum(took for _, _, took in latest),
            not any(side.scales for side in sides),
            seen.legend,
            self._psnr(order, panels, renderings),
        )

    def _psnr(self, order: Order, panels: Sequence[_Panel], renderings: Sequence[Rendering]) -> tuple[float, ...]:
        view = order.view
        if view is None or order.shown not in ("prediction", "error") or not all(panel.whole for panel in panels):
            return ()
        if any(rendering.alpha.shape != view.image.shape[:2] for rendering in renderings):
            return ()
        scores = [score(each, view, self.subjects[0].scene, PROTOCOLS["default"], only=["psnr"]) for each in renderings]
        return tuple(found.values["psnr"] for found in scores if "psnr" in found.values)

    def _truth(self, view: View, mount: Mount | None) -> Painted:
        size = (view.camera.width, view.camera.height) if mount is None else (mount.camera.width, mount.camera.height)
        picture = photograph(view, self.subjects[0].scene, size)
        return Painted(_mounted(picture, mount), size, 0.0, True, f"the photograph {view.name}")


def _columns(picture: Rendering, columns: tuple[int, int]) -> Rendering:
    cut = slice(*columns)
    normal = None if picture.normal is None else picture.normal[:, cut]
    return Rendering(picture.rgb[:, cut], picture.alpha[:, cut], picture.depth[:, cut], normal)


def _mounted(picture: Picture, mount: Mount | None) -> Picture:
    """A picture of a photograph's camera, at any scale, in its window."""
    if mount is None:
        return picture
    full = resized(picture, (mount.camera.width, mount.camera.height))
    return framed(full, (mount.width, mount.height), (mount.left, mount.top))


def _beside(pictures: Sequence[UInt8[ndarray, "h _ 3"]]) -> Picture:
    """Pictures from left to right; where one ends, its last column is a line."""
    lined = []
    for picture in pictures[:-1]:
        ended = picture.copy()
        ended[:, -1:] = EMPTY
        lined.append(ended)
    return np.concatenate([*lined, pictures[-1]], axis=1)
