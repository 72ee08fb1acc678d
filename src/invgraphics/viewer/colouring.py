"""Renderings as colours: what a person can choose to see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from invgraphics.core import Rendering, Scene, View
from invgraphics.experiments.evaluate import display
from invgraphics.metrics.base import OPAQUE

Picture = UInt8[ndarray, "h w 3"]

SHOWN = ("prediction", "truth", "error", "depth", "normal")
"""What can be shown; truth and error at the data set's cameras only."""
OF_VIEWS = ("truth", "error")

ERROR_COLOURS, DEPTH_COLOURS = "magma", "viridis_r"
ERROR_LIMIT = 0.25
"""Absolute error, of 1, from which on it is drawn as the brightest colour."""
EMPTY = (64, 66, 70)
"""Around a photograph, and where there is no surface that could have a depth or a normal."""


@dataclass(frozen=True)
class Coloured:
    """Pictures, one for each rendering, and what their colours mean."""

    pictures: list[Picture]
    legend: str


def coloured(
    shown: str, renderings: Sequence[Rendering], scenes: Sequence[Scene], truths: Sequence[Picture | None]
) -> Coloured:
    """Colour renderings alike.

    Args:
        shown: one of `SHOWN`; without a truth, its error is shown as the prediction.
        renderings: on the CPU, with normals where these are shown.
        scenes: whose background, colour space and unit of length count, one for each rendering.
        truths: photographs of the renderings' sizes, one for each.
    """
    pairs = list(zip(renderings, scenes, strict=True))
    if shown == "depth":
        return _depths(pairs)
    if shown == "normal":
        note = "x, y, z of the normal as red, green, blue"
        return Coloured([_normal(rendering) for rendering in renderings], note)
    pictures = [photographed(rendering, scene) for rendering, scene in pairs]
    known = [truth for truth in truths if truth is not None]
    if shown == "error" and len(known) == len(pictures):
        errors = [_error(picture, truth) for picture, truth in zip(pictures, known, strict=True)]
        return Coloured(errors, f"absolute error, mean of the channels: black is 0, white {ERROR_LIMIT:g} of 1 and more")
    return Coloured(pictures, "")


def photographed(rendering: Rendering, scene: Scene) -> Picture:
    """The colours that evaluations score: over the scene's background, for a display, in 8 bits."""
    return display(rendering.over(scene.background), scene).numpy()


def photograph(view: View, scene: Scene, size: tuple[int, int] | None = None) -> Picture:
    """A view's photograph over the scene's background, for a display, in 8 bits, resized to (width, height)."""
    return resized(display(view.over(scene.background), scene).numpy(), size)


def resized(picture: Picture, size: tuple[int, int] | None) -> Picture:
    """A picture at another size (width, height): averaged if that is smaller, smooth if it is larger."""
    from PIL import Image

    if size is None or size == (picture.shape[1], picture.shape[0]):
        return picture
    smaller = size[0] < picture.shape[1]
    way = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(picture).resize(size, way))


def framed(picture: Picture, window: tuple[int, int], corner: tuple[int, int]) -> Picture:
    """A picture in a window of (width, height) pixels, its corner at (column, row)."""
    height, width = picture.shape[:2]
    canvas = np.empty((window[1], window[0], 3), np.uint8)
    canvas[:] = EMPTY
    canvas[corner[1] : corner[1] + height, corner[0] : corner[0] + width] = picture
    return canvas


def _error(picture: Picture, truth: Picture) -> Picture:
    difference = np.abs(picture.astype(np.float32) - truth.astype(np.float32)).mean(axis=-1) / 255
    return _mapped(difference / ERROR_LIMIT, ERROR_COLOURS)


def _depths(pairs: Sequence[tuple[Rendering, Scene]]) -> Coloured:
    """World units, one range for all, from the first to the last percent."""
    depths = [rendering.depth.numpy() * scene.scale for rendering, scene in pairs]
    solid = [
        (rendering.alpha.numpy() >= OPAQUE) & np.isfinite(depth) for (rendering, _), depth in zip(pairs, depths, strict=True)
    ]
    values = np.concatenate([depth[mask] for depth, mask in zip(depths, solid, strict=True)])
    low, high = np.percentile(values, [1, 99]).tolist() if len(values) else (0.0, 1.0)
    span = max(high - low, 1e-9)
    pictures = []
    for depth, mask in zip(depths, solid, strict=True):
        picture = _mapped((np.where(mask, depth, low) - low) / span, DEPTH_COLOURS)
        picture[~mask] = EMPTY
        pictures.append(picture)
    legend = f"distance from the camera, {low:.3g} (bright) to {high:.3g} (dark) units of the world"
    return Coloured(pictures, legend if len(values) else "no surface in sight")


def _normal(rendering: Rendering) -> Picture:
    if rendering.normal is None:
        return np.full((*rendering.alpha.shape, 3), EMPTY, np.uint8)
    normal = rendering.normal.numpy()
    picture = np.round((normal.clip(-1, 1) + 1) / 2 * 255).astype(np.uint8)
    picture[np.linalg.norm(normal, axis=-1) < OPAQUE] = EMPTY
    return picture


def _mapped(unit: Float[ndarray, "h w"], colours: str) -> Picture:
    import matplotlib as mpl

    return np.round(mpl.colormaps[colours](unit.clip(0, 1))[..., :3] * 255).astype(np.uint8)
