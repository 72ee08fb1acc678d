"""Controls of the crop box, and its outline in the browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from invgraphics.core import Scene
from invgraphics.viewer.crop import CropBox

STEPS = 200
"""Positions of a slider."""
OUTLINE = (240, 228, 66)
EDGES = tuple((a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit)
"""Pairs of corners, as `CropBox.corners` counts them, that an edge joins."""


class CropPanel:
    """Check box and one range slider per axis, in world units along the axes of the scene's local frame.

    Args:
        gui: viser's interface of a browser.
        viser_scene: where the outline is drawn.
        scene: gives that of the first run, whose frame may change with its checkpoint.
    """

    def __init__(self, gui: Any, viser_scene: Any, scene: Callable[[], Scene]) -> None:
        self._scene, self._viser_scene = scene, viser_scene
        self._outline: Any = None
        self._outline_shown = True
        lo, hi = slider_range(scene())
        with gui.add_folder("Crop box", expand_by_default=False):
            self.enabled = gui.add_checkbox("Crop", False, hint="Renders only what is inside the box.")
            self.axes = [
                gui.add_multi_slider(
                    f"{name} (world units)",
                    low,
                    high,
                    (high - low) / STEPS,
                    (low, high),
                    hint=f"From the scene's origin along its {name} axis{', upwards' if name == 'z' else ''}.",
                )
                for name, low, high in zip("xyz", lo, hi, strict=True)
            ]

    @property
    def box(self) -> CropBox | None:
        """The box in the local frame; ``None`` while cropping is off."""
        if not self.enabled.value:
            return None
        scale = self._scene().scale
        (x0, x1), (y0, y1), (z0, z1) = ([float(end) / scale for end in axis.value] for axis in self.axes)
        return CropBox((x0, y0, z0), (x1, y1, z1))

    def show_outline(self, shown: bool) -> None:
        """Show or hide the outline."""
        self._outline_shown = shown
        if self._outline is not None:
            self._outline.visible = shown

    def draw(self) -> None:
        """Draw the outline of the current box, or remove it."""
        if self._outline is not None:
            self._outline.remove()
            self._outline = None
        if (box := self.box) is not None:
            corners = box.corners.numpy()
            self._outline = self._viser_scene.add_line_segments(
                "/crop", corners[list(EDGES)], OUTLINE, thickness=2.0, thickness_units="screen"
            )
            self._outline.visible = self._outline_shown


def slider_range(scene: Scene) -> tuple[list[float], list[float]]:
    """Lowest and highest slider position per axis, world units: the scene's box, or the cameras' reach in open space."""
    bounds, half = scene.bounds, scene.bounds.half
    if bounds.space == "contracted":
        cameras = torch.stack([view.camera.position for view in scene.train]) - bounds.centre
        half = cameras.abs().max().expand(3).maximum(half)
    lo, hi = (bounds.centre - half) * scene.scale, (bounds.centre + half) * scene.scale
    return lo.tolist(), hi.tolist()
