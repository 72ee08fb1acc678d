"""From what a browser asks for to pictures of its window: coarse first, finer when the camera rests, in pieces."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
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
    """

    gaze: Gaze
    window: tuple[int, int]
    shown: str = "prediction"
    view: View | None = None
    layout: Layout = "first"
    share: float = 0.5
    longest: int = 800
    resting: bool = False


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


class Painter:
    """Paints orders with one or two runs.

    Args:
        subjects: the runs; cameras are in the first one's local frame.
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        self.subjects = tuple(subjects)
        self.pace = Pace()

    def paint(self, order: Order, deliver: Callable[[Painted], None]) -> Job:
        """Work for the rendering thread that delivers pictures from coarse to fine."""
        side = order.layout == "side by side" and order.shown != "truth"
        window = (max(1, order.window[0] // (1 + side)), max(1, order.window[1]))
        mount = None
        if order.view is None:
            gaze = replace(order.gaze, aspect=order.gaze.aspect / (1 + side))
            camera = limited(gaze.camera(*window), order.longest)
        else:
            mount = Mount.of(limited(order.view.camera, order.longest), order.gaze.aspect / (1 + side))
            camera = mount.camera
        if order.shown == "truth" and order.view is not None:
            deliver(self._truth(order.view, mount))
            return
        scales = self.pace.scales(camera.width * (1 + side), camera.height, order.resting)
        for index, scale in enumerate(scales):
            began = time.perf_counter()
            panels = self._panels(order, scaled(camera, scale), mount)
            first = index == 0 and not order.resting
            renderings = []
            for panel in panels:
                renderings.append((yield from self._render(panel, order.shown == "normal", in_one_piece=first)))
            seconds = time.perf_counter() - began
            if first:
                self.pace.learn(sum(rendering.alpha.numel() for rendering in renderings), seconds)
            painted = self._compose(order, panels, renderings, mount)
            deliver(replace(painted, seconds=seconds, finest=index == len(scales) - 1))
            yield REST if first else 0.0

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
        rows = camera.height if in_one_piece else self.pace.rows(columns[1] - columns[0])
        parts = []
        for top in range(0, camera.height, rows):
            if parts:
                yield 0.0
            strip = part(camera, columns, (top, min(top + rows, camera.height)))
            began = time.perf_counter()
            parts.append(subject.render(strip, geometry))
            if not in_one_piece and strip.height == rows:
                self.pace.learn(strip.width * rows, time.perf_counter() - began)
        return Rendering.cat(parts)

    def _compose(self, order: Order, panels: Sequence[_Panel], renderings: Sequence[Rendering], mount: Mount | None) -> Painted:
        """Colour the panels alike and put them into the window."""
        camera = panels[0].camera
        size = (camera.width, camera.height)
        truths: list[Picture | None] = [None] * len(panels)
        if order.shown == "error" and order.view is not None:
            truth = photograph(order.view, self.subjects[0].scene, size)
            truths = [truth[:, slice(*panel.columns)] for panel in panels]
        seen = coloured(order.shown, renderings, [panel.subject.scene for panel in panels], truths)
        if order.layout == "side by side":
            picture = _beside([_mounted(picture, mount) for picture in seen.pictures])
        else:
            picture = _mounted(_beside(seen.pictures), mount)
        return Painted(picture, size, 0.0, False, seen.legend, self._psnr(order, panels, renderings))

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
