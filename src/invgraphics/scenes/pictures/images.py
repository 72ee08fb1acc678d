"""Photographs on disk: which there are, their sizes and their pixels, one picture at a time."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.scenes.pictures import png
from invgraphics.scenes.pictures.lens import Lens
from invgraphics.scenes.pictures.profiles import converted, profile_name, profile_words

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of photographs, in lower case."""

PHONE = (".heic", ".heif", ".avif")
"""Read where Pillow has a decoder for them."""

RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Sensor data: what Pillow finds in some of them is a thumbnail."""

_ORIENTATION = 0x0112  # EXIF tag
_TURNED = (5, 6, 7, 8)  # orientations that exchange width and height
_UPRIGHT = {
    2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE", 6: "ROTATE_270", 7: "TRANSVERSE", 8: "ROTATE_90",
}  # fmt: skip
"""Orientation -> Pillow's name of the transposition that makes the stored picture upright."""
_OPPOSITE = {6: 8, 8: 6}  # quarter turns; every other orientation undoes itself
_COLOURED = ("RGB", "RGBA", "RGBX", "RGBa", "P", "PA")  # modes whose colour profile may be one of RGB
_WIDTH, _HEIGHT = 256, 257  # TIFF tags

UNREADABLE = (OSError, ValueError, SyntaxError, TypeError, KeyError, OverflowError, struct.error)
"""What Pillow raises about damaged files and about EXIF tags of types that they should not have."""


@dataclass(frozen=True, eq=False)
class Photo:
    """Path and camera of a photograph whose pixels are not read yet.

    Attributes:
        path: the file.
        camera: pose and intrinsics of the photograph as it lies on disk (of a pinhole if there is a ``lens`` to remove).
        name: what the data set calls it.
        lens: the lens whose distortion has to be removed; replaces the camera's intrinsics.
        alpha: a second file whose brightness is the coverage.
        mask: a second file that is dark where pixels are masked out.
    """

    path: Path
    camera: Camera
    name: str
    lens: Lens | None = None
    alpha: Path | None = None
    mask: Path | None = None


def image_files(folder: Path) -> list[Path]:
    """List the photographs directly in ``folder``, sorted by name, without macOS's `._` files of the same names."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("._"))


def has_photographs(folder: Path) -> bool:
    """Whether there are photographs directly in ``folder``, in formats of telephones too; not, if it may not be looked into."""
    try:
        names = [one.name for one in folder.iterdir()] if folder.is_dir() else []
    except OSError:
        return False
    return any(name.lower().endswith(SUFFIXES + PHONE) and not name.startswith(".") for name in names)


def file_exists(path: Path) -> bool:
    """Whether a file exists; ``False`` for names that the file system does not take, which `Path.is_file` raises about."""
    return os.path.isfile(path)  # noqa: PTH113


def image_size(path: Path, like: tuple[int, int] | None = None) -> tuple[int, int]:
    """Read width and height in pixels from a file's header; ``like`` as in `read_pixels`.

    Raises:
        InputError: the file is missing, no picture, or cut short.
    """
    with _open(path) as image, _naming_damaged_file(path, image):
        width, height = _stored_size(image)
        return (height, width) if _is_turned(image, like) else (width, height)


def stored_size(path: Path) -> tuple[int, int]:
    """Read width and height in pixels as they are stored, for a camera whose file does not state them.

    Raises:
        InputError: the file is missing, no picture, or cut short.
    """
    with _open(path) as image, _naming_damaged_file(path, image):
        return _stored_size(image)


def read_pixels(path: Path, like: tuple[int, int] | None = None, *, clip: bool = False) -> UInt8[np.ndarray, "h w c"]:
    """Read a photograph as 8-bit colour: upright, or, where its camera is known, as that was calibrated.

    Sixteen-bit greys are rounded, palettes and greys become RGB; colour with an embedded profile becomes sRGB. Structure from
    motion reads pixels as they are stored (COLMAP ignores EXIF): with a camera the EXIF orientation is applied only where the
    stored shape is not the camera's.

    Args:
        path: the file.
        like: the camera's (width, height), if it is known.
        clip: whether values are taken as they are, and sixteen-bit greys cut off at 255: numbers of labels.

    Returns:
        Straight colour with 3 channels, or 4 where the file has an alpha channel.

    Raises:
        InputError: the file is missing, no picture, cut short, or of floating-point numbers.
    """
    with _open(path) as image, _naming_damaged_file(path, image):
        if wrong := png.damage(path):
            raise ValueError(wrong)
        turned = _loaded(image, upright=like is None or _is_turned(image, like))
        if turned.mode.startswith("I"):
            levels = np.asarray(turned).astype(np.float64)
            grey = (levels if clip else levels / 257 + 0.5).clip(0, 255).astype(np.uint8)
            return np.repeat(grey[:, :, None], 3, axis=2)
        clear = turned.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in turned.info
        colour = turned.convert("RGBA" if clear else "RGB")
        return np.array(converted(colour, image.info, path) if turned.mode in _COLOURED and not clip else colour)


def profile_of(path: Path) -> str:
    """Name of the colour profile from which `read_pixels` converts a photograph to sRGB; empty where it keeps the bytes."""
    with _open(path) as image, _naming_damaged_file(path, image):
        return profile_name(image.info) if image.mode in _COLOURED else ""


def profiles_note(photos: Sequence[Photo]) -> dict[str, str]:
    """A scene's note on photographs that are converted to sRGB; empty where none is."""
    return profile_words([profile_of(photo.path) for photo in photos])


def turn_like(pixels: UInt8[np.ndarray, "h w c"], photograph: Path) -> UInt8[np.ndarray, "height width c"]:
    """Turn pixels that belong to a photograph as it is stored the way that makes it upright."""
    from PIL import Image

    with _open(photograph) as image, _naming_damaged_file(photograph, image):
        orientation = _orientation(image)
    return pixels if orientation == 1 else np.array(Image.fromarray(pixels).transpose(Image.Transpose[_UPRIGHT[orientation]]))


@contextmanager
def _naming_damaged_file(path: Path, image: Any) -> Iterator[None]:
    """Turn decoding errors into an `InputError` that names the file; even its EXIF tags may lie behind the pixels."""
    width, height = _stored_size(image)
    try:
        yield
    except UNREADABLE as error:
        raise InputError(f"{path} is damaged ({width}x{height}): {error}.", "Copy the file again.") from error


def _open(path: Path) -> Any:
    from PIL import Image, UnidentifiedImageError

    try:
        if wrong := png.cut_off(path):
            raise InputError(f"{path} is damaged: {wrong}.", "Copy the file again.")
        image = Image.open(path)
        if image.mode == "F":
            image.close()
            sentence = f"{path} has floating-point pixels, whose range is not known."
            raise InputError(sentence, "Convert it to 8 or 16 bits per channel.")
        return image
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except Image.DecompressionBombError as error:
        count = re.search(r"\d+", str(error))
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)  # Pillow warns at half of what it refuses
        pixels = f"{int(count[0]) / 1e6:,.0f}" if count else "many"
        sentence = f"{path} has {pixels} million pixels; no more than {limit / 1e6:,.0f} million are read."
        raise InputError(sentence, "Make it smaller.") from error
    except (UnidentifiedImageError, *UNREADABLE) as error:
        raise InputError(f"{path} cannot be read as a picture: {type(error).__name__}.", "Copy or convert the file.") from error


def _orientation(image: Any) -> int:
    return exif_orientation(image.getexif())


def exif_orientation(exif: Mapping[int, Any]) -> int:
    """EXIF orientation, 1 to 8; 1, as it is stored, where there is none or what is there is no such number."""
    found = exif.get(_ORIENTATION, 1)
    return found if found in _UPRIGHT else 1


def _stored_size(image: Any) -> tuple[int, int]:
    """Width and height as stored; the size that Pillow states of a TIFF is that after its orientation is applied."""
    return (image.tag_v2[_WIDTH], image.tag_v2[_HEIGHT]) if image.format == "TIFF" else image.size


def _loaded(image: Any, upright: bool) -> Any:
    """A picture with its pixels, upright or as they are stored.

    Not by Pillow's `exif_transpose`, which writes EXIF anew and fails at tags of wrong types.
    """
    from PIL import Image

    orientation = _orientation(image)
    image.load()
    made_upright = _orientation(image) != orientation  # TIFFs, of which Pillow then forgets it
    if orientation == 1 or upright == made_upright:
        return image
    return image.transpose(Image.Transpose[_UPRIGHT[orientation if upright else _OPPOSITE.get(orientation, orientation)]])


def _is_turned(image: Any, like: tuple[int, int] | None) -> bool:
    """Whether reading exchanges width and height: EXIF says so, and the camera, if known, has the turned shape only."""
    if _orientation(image) not in _TURNED:
        return False
    width, height = _stored_size(image)
    return like is None or (like[0] - like[1]) * (width - height) < 0


def match_sizes(photos: Sequence[Photo]) -> list[Photo]:
    """Scale each camera to its file's size: photographs downscaled as a whole keep their calibration.

    Reads file headers only.

    Raises:
        InputError: a file has another shape than its camera says, or is scaled otherwise than the rest.
    """
    result: list[Photo] = []
    first = 1.0
    for photo in photos:
        stated = (photo.camera.width, photo.camera.height)
        found = image_size(photo.path, like=stated)
        scale = found[0] / stated[0]
        # A rounded-off pixel on either side is no change of shape.
        if abs(found[1] - scale * stated[1]) > 1 + scale:
            raise InputError(
                f"{photo.path} has {found[0]}x{found[1]} pixels, its camera says {stated[0]}x{stated[1]}.",
                "Pictures may be scaled, but must keep the shape they were calibrated with.",
            )
        first = scale if not result else first
        if abs(scale / first - 1) > 0.01:
            raise InputError(
                f"{photo.path} has {found[0]}x{found[1]} pixels, which is scaled unlike {photos[0].path.name}.",
                "All pictures of a set must have the sizes that their cameras say.",
            )
        result.append(photo if found == stated else _rescaled(photo, *found))
    return result


def _rescaled(photo: Photo, width: int, height: int) -> Photo:
    lens = photo.lens
    if lens is not None:
        camera = lens.colmap()
        camera.rescale(width, height)
        lens = Lens(lens.model, tuple(float(value) for value in camera.params), width, height)
    return replace(photo, camera=photo.camera.resized(width, height), lens=lens)
