"""Photographs to import, not read yet: files of a folder, or the pictures of a data set."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.photos.job import PhotoJob
from invgraphics.scenes.pictures import png
from invgraphics.scenes.pictures.images import (
    PHONE,
    RAW,
    SUFFIXES,
    UNREADABLE,
    exif_orientation,
    has_photographs,
    image_files,
    profile_of,
    read_pixels,
)
from invgraphics.scenes.pictures.masks import mask_of, masks_folder, read_upright_mask

FOCAL_RANGE = (0.2, 10.0)  # of the longest side; beyond it an EXIF focal length is a mistake


@dataclass(frozen=True, eq=False)
class Source:
    """One picture, not read yet: its name, group, known intrinsics (of what ``load`` returns), mask and EXIF orientation.

    ``load`` returns it upright, in sRGB; ``profile`` reads the name of the colour profile it is converted from, if any.
    ``mask`` reads which pixels count, at the width and height of what ``load`` returns.
    """

    name: str
    load: Callable[[], UInt8[np.ndarray, "h w c"]]
    group: str
    focal_share: float | None = None  # focal length over the longest side
    camera: Camera | None = None
    mask: Callable[[int, int], Bool[np.ndarray, "h w"]] | None = None
    orientation: int = 1
    profile: Callable[[], str] | None = None


def find_sources(job: PhotoJob, skipped: dict[str, str]) -> list[Source]:
    """List the photographs of a job's folder, or the pictures of the data set that it is, in natural name order.

    Args:
        job: names the folder.
        skipped: gets why other files are left out, by name.
    """
    is_data_set = not image_files(job.path) and _is_data_set(job.path)
    return _data_set(job) if is_data_set else _files(job.path, skipped)


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key: digits count as numbers, so that photograph 9 comes before photograph 10."""
    import re

    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def readable(text: str) -> str:
    """A text that any file and terminal takes: bytes of a file's name that are not UTF-8 are spelled out."""
    return text.encode("utf-8", "backslashreplace").decode()


def _files(folder: Path, skipped: dict[str, str]) -> list[Source]:
    _register_decoders()
    found, masks = [], masks_folder(folder)
    for path in sorted(folder.iterdir(), key=lambda path: natural(path.name)):
        suffix = path.suffix.lower()
        if suffix in RAW:
            skipped[readable(path.name)] = "raw sensor data; export it as JPEG or PNG"
        elif suffix in SUFFIXES + PHONE and path.is_file() and not path.name.startswith("."):
            exif = _exif(path)
            group = "/".join(str(exif.get(tag, "")) for tag in _LENS_TAGS)
            mask = None if masks is None else mask_of(path.name, masks)
            read = None if mask is None else partial(read_upright_mask, mask, path)
            load, focal, orientation = partial(read_pixels, path), _focal_share(path, exif), exif_orientation(exif)
            profile = partial(profile_of, path)
            found.append(Source(readable(path.name), load, group, focal, mask=read, orientation=orientation, profile=profile))
    for path in sorted(folder.iterdir()) if found else ():
        if path != masks and has_photographs(path):
            skipped[f"{readable(path.name)}/"] = "a folder with photographs of its own; put all of them into one"
    return found


_FOCAL_35MM = 0xA405
_LENS_TAGS = (0x010F, 0x0110, 0x920A, _FOCAL_35MM, 0xA434)  # make, model, focal length, its 35 mm equivalent, lens


def _exif(path: Path) -> dict[int, Any]:
    from PIL import Image

    try:
        if png.cut_off(path):
            return {}
        with Image.open(path) as image:
            exif = image.getexif()
            return dict(exif) | dict(exif.get_ifd(0x8769))
    except (*UNREADABLE, Image.DecompressionBombError):
        return {}


def _focal_share(path: Path, exif: Mapping[int, Any]) -> float | None:
    """Focal length over the longest side, as COLMAP reads it from EXIF (35 mm equivalent, focal plane, sensor data base).

    Of files in which COLMAP finds none (HEIC, AVIF, WebP, which only Pillow decodes), by the 35 mm equivalent over the film's
    width of 36 mm.
    """
    from invgraphics.scenes.colmap_library import pycolmap

    share = _number(exif.get(_FOCAL_35MM)) / 36
    with suppress(ValueError, RuntimeError):
        camera = pycolmap.infer_camera_from_image(str(path))
        if camera.has_prior_focal_length:
            share = camera.mean_focal_length() / max(camera.width, camera.height)
    return share if FOCAL_RANGE[0] < share < FOCAL_RANGE[1] else None


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0


def _register_decoders() -> None:
    """Register Pillow's HEIC plug-in where it is installed."""
    try:
        from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports]
    except ImportError:
        return
    register_heif_opener()


def _is_data_set(folder: Path) -> bool:
    from invgraphics.scenes.open import find_loader

    try:
        find_loader(folder)
    except InputError:
        return False
    return True


def _data_set(job: PhotoJob) -> list[Source]:
    """A data set's pictures as fits see them: straight, with their alpha, no larger than they are worked with."""
    from invgraphics.scenes.open import find_loader

    scene = find_loader(job.path).load(job.path, SceneOptions(size=job.max_size, test_views=None))
    sources: list[Source] = []
    for split in ("train", "val", "test"):
        for view in getattr(scene, split):
            name = readable(Path(view.name).name)
            label = name if Path(name).suffix.lower() in SUFFIXES else f"{split}-{name}"

            def load(view: Any = view) -> UInt8[np.ndarray, "h w c"]:
                image = (view.colour() * 255 + 0.5).byte().numpy()
                alpha = [] if view.alpha is None else [(view.opacity() * 255 + 0.5).byte().numpy()[..., None]]
                return np.concatenate([image, *alpha], axis=-1)

            mask = None if view.mask is None else lambda width, height, view=view: view.mask.numpy()
            sources.append(Source(label, load, _calibration(view.camera), camera=view.camera, mask=mask))
    return sorted(sources, key=lambda source: natural(source.name))


def _calibration(camera: Camera) -> str:
    """Name of a group of cameras of one calibration: focal lengths equal to a thousandth, principal points to a pixel."""
    return "data set f={:.3g},{:.3g} c={:.0f},{:.0f}".format(*camera.focal.tolist(), *camera.principal_point.tolist())
