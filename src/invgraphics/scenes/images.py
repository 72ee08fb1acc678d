"""Photographs from disk: reading, undistortion at full size and area-averaged resizing, one picture at a time."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from invgraphics.core import Camera, View
from invgraphics.errors import InputError
from invgraphics.scenes import png
from invgraphics.scenes.lens import Lens, straighten, undistort

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""What counts as a photograph, in lower case."""

RESIZE = "area average (exact box filter, colour weighted by alpha)"
"""The filter, as recorded in a scene's notes."""

_ORIENTATION = 0x0112  # EXIF tag
_TURNED = (5, 6, 7, 8)  # orientations that exchange width and height


@dataclass(frozen=True, eq=False)
class Photo:
    """Path and camera of a photograph whose pixels are not read yet.

    Attributes:
        path: the file.
        camera: pose and intrinsics of the photograph as it lies on disk (of a pinhole if there is a ``lens`` to remove).
        name: what the data set calls it.
        lens: the lens whose distortion has to be removed; replaces the camera's intrinsics.
        alpha: a second file whose brightness is the coverage.
    """

    path: Path
    camera: Camera
    name: str
    lens: Lens | None = None
    alpha: Path | None = None


def image_files(folder: Path) -> list[Path]:
    """List the photographs directly in ``folder``, sorted by name, without macOS's `._` files of the same names."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("._"))


def file_exists(path: Path) -> bool:
    """Whether a file exists; ``False`` for names that the file system does not take, which `Path.is_file` raises about."""
    return os.path.isfile(path)  # noqa: PTH113


def image_size(path: Path, like: tuple[int, int] | None = None) -> tuple[int, int]:
    """Read width and height in pixels from a file's header; ``like`` as in `read_pixels`.

    Raises:
        InputError: the file is missing, no picture, or cut short.
    """
    with _open(path) as image, _naming_damaged_file(path, image):
        return image.size[::-1] if _is_turned(image, like) else image.size


def stored_size(path: Path) -> tuple[int, int]:
    """Read width and height in pixels as they are stored, for a camera whose file does not state them.

    Raises:
        InputError: the file is missing or no picture.
    """
    with _open(path) as image:
        return image.size


def read_pixels(path: Path, like: tuple[int, int] | None = None) -> UInt8[np.ndarray, "h w c"]:
    """Read a photograph as 8-bit colour: upright, or, where its camera is known, as that was calibrated.

    Sixteen-bit greys are rounded, palettes and greys become RGB. Structure from motion looks at pixels as they are stored
    (COLMAP ignores EXIF): with a camera the EXIF orientation is applied only where the stored shape is not the camera's.

    Args:
        path: the file.
        like: the camera's (width, height), if it is known.

    Returns:
        Straight colour with 3 channels, or 4 where the file has an alpha channel.

    Raises:
        InputError: the file is missing, no picture, cut short, or of floating-point numbers.
    """
    from PIL import ImageOps

    with _open(path) as image, _naming_damaged_file(path, image):
        if wrong := png.damage(path):
            raise ValueError(wrong)
        upright = ImageOps.exif_transpose(image) if like is None or _is_turned(image, like) else image
        if upright.mode.startswith("I"):
            grey = (np.asarray(upright).astype(np.float64) / 257 + 0.5).clip(0, 255).astype(np.uint8)
            return np.repeat(grey[:, :, None], 3, axis=2)
        clear = upright.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in upright.info
        return np.array(upright.convert("RGBA" if clear else "RGB"))


@contextmanager
def _naming_damaged_file(path: Path, image: Any) -> Iterator[None]:
    """Turn decoding errors into an `InputError` that names the file; even its EXIF tags may lie behind the pixels."""
    width, height = image.size
    try:
        yield
    except (OSError, ValueError, SyntaxError) as error:
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
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path} cannot be read as a picture: {type(error).__name__}.", "Copy or convert the file.") from error


def _is_turned(image: Any, like: tuple[int, int] | None) -> bool:
    """Whether reading exchanges width and height: EXIF says so, and the camera, if known, has the turned shape only."""
    if image.getexif().get(_ORIENTATION, 1) not in _TURNED:
        return False
    return like is None or (like[0] - like[1]) * (image.width - image.height) < 0


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


def load_view(photo: Photo, size: int | tuple[int, int] | None = None) -> View:
    """Read, undistort and resize one photograph whose camera fits its file (see `match_sizes`)."""
    return make_view(photo.camera, _with_alpha(photo), photo.name, size, photo.lens)


def make_view(
    camera: Camera,
    pixels: UInt8[np.ndarray, "h w c"],
    name: str,
    size: int | tuple[int, int] | None = None,
    lens: Lens | None = None,
) -> View:
    """Make a view from pixels in memory, undistorted and resized: 8-bit colours, float32 camera.

    Args:
        camera: of these pixels; its focal lengths and principal point are replaced if there is a ``lens``.
        pixels: straight colour, or colour and alpha.
        name: the view's name.
        size: as in `wanted_size`.
        lens: the distortion to remove.
    """
    height, width = pixels.shape[:2]
    final = wanted_size(width, height, size)
    if lens is not None or final != (width, height):
        values = _premultiplied(pixels)
        if lens is not None:
            straight = straighten(lens)
            values = undistort(values, straight)
            new = camera.focal.new_tensor
            camera = replace(camera, focal=new(straight.focal), centre=new(straight.centre))
        pixels = _straight(area_resize(values, *final))
        camera = camera.resized(*final)
    image = torch.from_numpy(np.ascontiguousarray(pixels[:, :, :3]))
    alpha = None
    if pixels.shape[2] == 4 and pixels[:, :, 3].min() < 255:
        alpha = torch.from_numpy(np.ascontiguousarray(pixels[:, :, 3]))
    return View(camera.to(torch.float32), image, name, alpha=alpha)


def _with_alpha(photo: Photo) -> UInt8[np.ndarray, "h w c"]:
    like = (photo.camera.width, photo.camera.height)
    pixels = read_pixels(photo.path, like)
    if photo.alpha is None:
        return pixels
    coverage = read_pixels(photo.alpha, like)[:, :, :3].max(axis=2, keepdims=True)
    if coverage.shape[:2] != pixels.shape[:2]:
        (h, w), (mask_h, mask_w) = pixels.shape[:2], coverage.shape[:2]
        raise InputError(f"{photo.alpha} has {mask_w}x{mask_h} pixels, its photograph has {w}x{h}.")
    return np.concatenate([pixels[:, :, :3], coverage], axis=2)


def _premultiplied(pixels: UInt8[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    values = pixels.astype(np.float32)
    if values.shape[2] == 4:
        values[:, :, :3] *= values[:, :, 3:] / 255
    return values


def _straight(values: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    if values.shape[2] == 4:
        alpha = values[:, :, 3:]
        colour = np.divide(values[:, :, :3] * 255, alpha, out=np.zeros_like(values[:, :, :3]), where=alpha > 0)
        values = np.concatenate([colour, alpha], axis=2)
    return (values.clip(0, 255) + 0.5).astype(np.uint8)
