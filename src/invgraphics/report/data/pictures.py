"""Checked reading of pictures and arrays from run folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from invgraphics.arrays import read_numbers
from invgraphics.errors import InputError
from invgraphics.scenes.pictures import png

Arrays = dict[str, Float[ndarray, "..."]]
"""What an ``.npz`` holds: alpha, depth, normal and so on."""


def read_picture(path: Path) -> UInt8[ndarray, "h w 3"]:
    """Read an 8-bit colour picture.

    Raises:
        InputError: it is missing or broken.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        if wrong := png.cut_off(path):  # Pillow would reserve what it claims
            raise InputError(f"'{path}' is damaged: {wrong}.")
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise InputError(f"'{path}' is missing.") from None
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError) as error:
        raise InputError(f"'{path}' is not a readable picture: {error}.") from None


def read_arrays(path: Path, size: tuple[int, int]) -> Arrays:
    """Read all arrays of an ``.npz`` as float32, within the limits of `invgraphics.tables`.

    Args:
        path: of the archive.
        size: height and width of the picture beside it.

    Raises:
        InputError: it is missing or broken, or an array holds no real numbers or has another size.
    """
    arrays = read_numbers(path)
    for name, array in arrays.items():
        expected = (*size, 3) if name in ("rgb", "normal") else size
        if array.shape != expected:
            raise InputError(
                f"'{name}' of '{path}' has the shape {array.shape}, its picture {expected}.", "Score the run again."
            )
    return {name: array.astype(np.float32) for name, array in arrays.items()}
