"""Masks of photographs: pixels that neither a fit nor a score uses, such as people who walk past."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from invgraphics.errors import InputError
from invgraphics.scenes.pictures.images import Photo, file_exists, image_size, read_pixels, turn_like
from invgraphics.scenes.pictures.resize import area_resize

FOLDER = "masks"
"""Where masks lie beside a folder of photographs."""
LOSSY = (".jpg", ".jpeg", ".webp")
"""Endings of formats in which black is not exactly 0. In others any number above counts, as for COLMAP and nerfstudio."""
WHOLE = 1 - 1e-6
"""Valid share of what a pixel covers from which on it is valid: all of it, up to rounding."""


def with_masks_beside(photos: Sequence[Photo], images: Path) -> list[Photo]:
    """Give photographs the masks in `FOLDER` in or beside their folder, named as by COLMAP, ``NAME.jpg.png``, or ``NAME.png``.

    Args:
        photos: without masks.
        images: their folder, to which their names are relative.
    """
    folder = masks_folder(images)
    if folder is None:
        return list(photos)
    masked = [replace(photo, mask=mask_of(photo.name, folder)) for photo in photos]
    if photos and not any(photo.mask for photo in masked):
        print(f"{folder} has no mask of any photograph: expected {photos[0].name}.png.", file=sys.stderr)
    return masked


def masks_folder(images: Path) -> Path | None:
    """`FOLDER` in a folder of photographs, else beside it; ``None`` where there is none."""
    return next((place / FOLDER for place in (images, images.absolute().parent) if (place / FOLDER).is_dir()), None)


def mask_of(name: str, folder: Path) -> Path | None:
    """The mask of a photograph; where names begin with their folder (``images/0.jpg``), those of masks need not."""
    own = Path(name)
    names = [folder / name for name in (own, *([Path(*own.parts[1:])] if len(own.parts) > 1 else []))]
    candidates = [path for name in names for path in (name.with_name(name.name + ".png"), name.with_suffix(".png"), name)]
    return next((path for path in candidates if file_exists(path)), None)


def read_mask(mask: Path, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Read a mask as a picture of a size: 255 where pixels are valid, which is where they are not black.

    In lossy formats they are valid where they are brighter than half of the maximum.

    Args:
        mask: the file; of a larger one than the photograph all pixels that a photograph's covers must be valid, of a smaller
            one the nearest is taken.
        width: of the photograph in pixels.
        height: of the photograph.

    Raises:
        InputError: it is missing or no picture, has another shape than the photograph, or masks all of it.
    """
    values = brightness(read_pixels(mask, (width, height), clip=True))
    high, wide = values.shape
    if abs(wide * height - high * width) > max(width, height, wide, high):
        raise InputError(f"{mask} has {wide}x{high} pixels, its photograph has {width}x{height}.")
    if not values.any():
        raise InputError(f"{mask} is black: no pixel of its photograph counts.", "Leave the photograph out, or its mask.")
    bright = values > (values.max() // 2 if mask.suffix.lower() in LOSSY else 0)
    if wide >= width and high >= height:
        valid = area_resize(bright[..., None].astype(np.float64), width, height)[..., 0] > WHOLE
    else:
        rows, columns = (
            (2 * np.arange(count) + 1) * stored // (2 * count) for count, stored in ((height, high), (width, wide))
        )
        valid = bright[rows][:, columns]
    return np.repeat(np.where(valid, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)


def read_upright_mask(mask: Path, photograph: Path, width: int, height: int) -> Bool[np.ndarray, "h w"]:
    """Read the mask of a photograph that is read upright: drawn on it so, or as it is stored if only that has its shape.

    Args:
        mask: the file.
        photograph: whose EXIF orientation counts.
        width: of the photograph in pixels, upright.
        height: of the photograph, upright.

    Returns:
        Which pixels are valid.

    Raises:
        InputError: as `read_mask` does.
    """
    wide, high = image_size(mask, like=(width, height))
    if (wide - high) * (width - height) >= 0:
        return read_mask(mask, width, height)[..., 0] == 255
    return turn_like(read_mask(mask, height, width), photograph)[..., 0] == 255


def brightness(pixels: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w"]:
    """Brightness of a mask's pixels: its alpha where only that varies, as of a cut-out; of masks of 0 and 1, 0 and 255."""
    values = pixels[:, :, :3].max(axis=2)
    if pixels.shape[2] == 4 and values.min() == values.max() and pixels[:, :, 3].min() < pixels[:, :, 3].max():
        values = pixels[:, :, 3]
    return values * np.uint8(255) if values.max() == 1 else values


def masks_note(photos: Sequence[Photo]) -> dict[str, str]:
    """A scene's note on masks; empty where no photograph has one."""
    masked = sum(photo.mask is not None for photo in photos)
    return {"masks": f"{masked} of {len(photos)} photographs have one: dark pixels do not count"} if masked else {}
