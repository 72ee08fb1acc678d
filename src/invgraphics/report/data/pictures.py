"""Checked reading of pictures and arrays from run folders."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from invgraphics.errors import InputError

Arrays = dict[str, Float[ndarray, "..."]]
"""What an ``.npz`` holds: alpha, depth, normal and so on."""


def read_picture(path: Path) -> UInt8[ndarray, "h w 3"]:
    """Read an 8-bit colour picture.

    Raises:
        InputError: it is missing or broken.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise InputError(f"'{path}' is missing.") from None
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError) as error:
        raise InputError(f"'{path}' is not a readable picture: {error}.") from None


def read_arrays(path: Path) -> Arrays:
    """Read all arrays of an ``.npz`` as float32; pickled objects are refused.

    Raises:
        InputError: it is missing or broken.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name].astype(np.float32) for name in archive.files}
    except FileNotFoundError:
        raise InputError(f"'{path}' is missing.") from None
    except (OSError, ValueError, EOFError, BadZipFile, AttributeError) as error:
        raise InputError(f"'{path}' is not a readable .npz archive: {error}.") from None
