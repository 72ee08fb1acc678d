"""Assembling renderings of one or two runs to the image of a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from invgraphics.core import Rendering
from invgraphics.tools.colorize import EMPTY, Picture, pad_to_window, resize_image
from invgraphics.viewer.cameras import LetterboxedView


def crop_columns(picture: Rendering, columns: tuple[int, int]) -> Rendering:
    """A half-open range of columns of a rendering."""
    cut = slice(*columns)
    normal = None if picture.normal is None else picture.normal[:, cut]
    return Rendering(picture.rgb[:, cut], picture.alpha[:, cut], picture.depth[:, cut], normal)


def letterboxed(picture: Picture, letterbox: LetterboxedView | None) -> Picture:
    """Resize an image of a photograph's camera and pad it to the window."""
    if letterbox is None:
        return picture
    full = resize_image(picture, (letterbox.camera.width, letterbox.camera.height))
    return pad_to_window(full, (letterbox.width, letterbox.height), (letterbox.left, letterbox.top))


def side_by_side_image(pictures: Sequence[UInt8[ndarray, "h _ 3"]]) -> Picture:
    """Concatenate images from left to right, separated by a line."""
    lined = []
    for picture in pictures[:-1]:
        ended = picture.copy()
        ended[:, -1:] = EMPTY
        lined.append(ended)
    return np.concatenate([*lined, pictures[-1]], axis=1)
