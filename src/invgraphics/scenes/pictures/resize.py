"""Downscaling of pictures by exact area averages."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from invgraphics.errors import InputError

RESIZE = "area average (exact box filter, colour weighted by alpha)"
"""The filter, as recorded in a scene's notes."""


def area_resize(values: Float[np.ndarray, "h w c"], width: int, height: int) -> Float[np.ndarray, "height width c"]:
    """Downscale by exact area average; pixels that are cut contribute by their covered share.

    Args:
        values: picture, colours premultiplied where it has alpha.
        width: new width in pixels, at most the present one.
        height: new height, likewise.
    """
    return _average(_average(values, height).swapaxes(0, 1), width).swapaxes(0, 1)


def _average(values: Float[np.ndarray, "n m c"], count: int) -> Float[np.ndarray, "count m c"]:
    n = len(values)
    if count == n:
        return values
    edges = np.arange(count + 1) * (n / count)
    whole = np.floor(edges).astype(np.int64)
    part = (edges - whole).astype(values.dtype)[:, None, None]
    part[-1] = 0.0  # the last edge is the border, whatever its rounding
    # Sum from whole edge to whole edge, less the part before the new pixel's beginning, plus the part up to its end.
    sums = np.add.reduceat(values, whole[:-1], axis=0)
    cut = values[np.minimum(whole, n - 1)] * part
    return (sums - cut[:-1] + cut[1:]) * values.dtype.type(count / n)


def wanted_size(width: int, height: int, size: int | tuple[int, int] | None) -> tuple[int, int]:
    """Compute the (width, height) to which a photograph is resized; never enlarged.

    Args:
        width: present width in pixels.
        height: present height.
        size: the longest side, or (width, height), or ``None`` for no change.

    Raises:
        InputError: the wanted shape would squash or enlarge the picture.
    """
    if size is None:
        return width, height
    if isinstance(size, int):
        scale = min(1.0, size / max(width, height))
        return max(1, round(width * scale)), max(1, round(height * scale))
    if abs(math.log((size[0] / size[1]) / (width / height))) > 0.05:
        remedy = "Give one number, the longest side, to keep the shape."
        raise InputError(f"Size {size[0]}x{size[1]} would squash photographs of {width}x{height} pixels.", remedy)
    if size[0] > width or size[1] > height:
        raise InputError(f"Size {size[0]}x{size[1]} is larger than the photographs ({width}x{height}).")
    return size
