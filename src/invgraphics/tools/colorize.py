"""8-bit images of renderings: colour, error, depth and normals, for display."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from invgraphics.core import Rendering, Scene, View
from invgraphics.experiments.evaluate import display
from invgraphics.metrics.base import OPAQUE

Picture = UInt8[ndarray, "h w 3"]

OUTPUTS = ("prediction", "truth", "error", "depth", "normal")
"""Outputs that can be displayed."""
NEEDS_TRUTH = ("truth", "error")
"""Outputs that exist at the data set's cameras only."""

ERROR_COLOURS, DEPTH_COLOURS = "magma", "viridis_r"
ERROR_LIMIT = 0.25
"""Absolute error, of 1, at the end of the colour map."""
EMPTY = (64, 66, 70)
"""Letterbox bars, and pixels without depth or normal."""


@dataclass(frozen=True)
class ColorizedImages:
    """One image per rendering, and the legend of their colours."""

    pictures: list[Picture]
    legend: str


def colorize(
    output: str,
    renderings: Sequence[Rendering],
    scenes: Sequence[Scene],
    truths: Sequence[Picture | None],
    span: tuple[float, float] | None = None,
) -> ColorizedImages:
    """Map renderings to 8-bit images with one shared colour scale.

    Args:
        output: one of `OUTPUTS`; without a truth, the prediction replaces the error.
        renderings: on the CPU, with normals where these are displayed.
        scenes: whose background, colour space and unit of length count, one for each rendering.
        truths: photographs of the renderings' sizes, one for each.
        span: nearest and farthest depth in world units; ``None`` for the renderings' own.
    """
    pairs = list(zip(renderings, scenes, strict=True))
    if output == "depth":
        return _depths(renderings, scenes, span)
    if output == "normal":
        note = "x, y, z of the normal as red, green, blue"
        return ColorizedImages([_normal(rendering) for rendering in renderings], note)
    pictures = [to_display(rendering, scene) for rendering, scene in pairs]
    known = [truth for truth in truths if truth is not None]
    if output == "error" and len(known) == len(pictures):
        errors = [_error(picture, truth) for picture, truth in zip(pictures, known, strict=True)]
        return ColorizedImages(errors, f"absolute error, mean of the channels: black is 0, white {ERROR_LIMIT:g} of 1 and more")
    return ColorizedImages(pictures, "")


def to_display(rendering: Rendering, scene: Scene) -> Picture:
    """Composite over the scene's background and encode as 8-bit display colours, as evaluation does."""
    return display(rendering.over(scene.background), scene).numpy()


def true_image(view: View, scene: Scene, size: tuple[int, int] | None = None) -> Picture:
    """Convert a view's ground truth over the scene's background to 8-bit display colours, resized to (width, height)."""
    return resize_image(display(view.over(scene.background), scene).numpy(), size)


def resize_image(picture: Picture, size: tuple[int, int] | None) -> Picture:
    """Resample to (width, height): box filter when shrinking, bilinear when enlarging."""
    from PIL import Image

    if size is None or size == (picture.shape[1], picture.shape[0]):
        return picture
    smaller = size[0] < picture.shape[1]
    resample = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(picture).resize(size, resample))


def pad_to_window(picture: Picture, window: tuple[int, int], corner: tuple[int, int]) -> Picture:
    """Pad an image to a window of (width, height) pixels, its corner at (column, row)."""
    height, width = picture.shape[:2]
    canvas = np.empty((window[1], window[0], 3), np.uint8)
    canvas[:] = EMPTY
    canvas[corner[1] : corner[1] + height, corner[0] : corner[0] + width] = picture
    return canvas


def _error(picture: Picture, truth: Picture) -> Picture:
    difference = np.abs(picture.astype(np.float32) - truth.astype(np.float32)).mean(axis=-1) / 255
    return _mapped(difference / ERROR_LIMIT, ERROR_COLOURS)


def depth_range(renderings: Sequence[Rendering], scenes: Sequence[Scene]) -> tuple[float, float] | None:
    """The 1st and 99th percentile of all depths in world units; ``None`` where no rendering shows a surface."""
    maps = _surface_depths(renderings, scenes)
    values = np.concatenate([depth[solid] for depth, solid in maps])
    if not len(values):
        return None
    low, high = np.percentile(values, [1, 99]).tolist()
    return low, high


def _surface_depths(
    renderings: Sequence[Rendering], scenes: Sequence[Scene]
) -> list[tuple[Float[ndarray, "h w"], Bool[ndarray, "h w"]]]:
    """Depth in world units, and the mask of pixels that show a surface."""
    depths = [rendering.depth.numpy() * scene.scale for rendering, scene in zip(renderings, scenes, strict=True)]
    return [
        (depth, (rendering.alpha.numpy() >= OPAQUE) & np.isfinite(depth))
        for rendering, depth in zip(renderings, depths, strict=True)
    ]


def _depths(renderings: Sequence[Rendering], scenes: Sequence[Scene], span: tuple[float, float] | None) -> ColorizedImages:
    """Map depths to 8-bit images over one shared depth range."""
    found = span or depth_range(renderings, scenes)
    low, high = found or (0.0, 1.0)
    pictures = []
    for depth, solid in _surface_depths(renderings, scenes):
        picture = _mapped((np.where(solid, depth, low) - low) / max(high - low, 1e-9), DEPTH_COLOURS)
        picture[~solid] = EMPTY
        pictures.append(picture)
    legend = f"distance from the camera, {low:.3g} (bright) to {high:.3g} (dark) world units"
    return ColorizedImages(pictures, legend if found else "no surface in sight")


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
