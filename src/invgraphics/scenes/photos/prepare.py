"""Working copies of photographs: upright, 8 bits, of a bounded size, each different from all others, grouped by camera."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, UInt8

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.files import write_picture, write_text
from invgraphics.scenes.photos.job import PhotoJob
from invgraphics.scenes.photos.sources import Source, find_sources, readable
from invgraphics.scenes.pictures.images import PHONE, has_photographs
from invgraphics.scenes.pictures.views import make_view
from invgraphics.scenes.process import Progress
from invgraphics.tables import read_json

PHOTOS, MASKS, OWN_MASKS, PREPARED = "photos", "masks", "own-masks", "prepared.json"

ADVICE = "Take 20 to 60 sharp photographs while walking around the scene, each overlapping its neighbours by two thirds."

LEAST = 3
"""Fewest photographs of a scene: no strategy keeps a reconstruction of fewer."""

_OPAQUE = 128


@dataclass(frozen=True)
class Prepared:
    """A working copy.

    Attributes:
        name: its file name, which the scene keeps.
        source: what the person calls it.
        width: pixels.
        height: pixels.
        group: photographs with the same text share a camera.
        focal: focal length from EXIF or from the data set, pixels of the working copy.
        centre: principal point, where the data set states it.
        masked: whether no features are looked for in parts of it: where it is transparent, or has a mask.
        own_mask: whether it has a mask, beside the photographs or of a data set, which the scene keeps.
        orientation: EXIF orientation of the photograph, by which the working copy is turned upright.
        profile: name of the colour profile from which the working copy is converted to sRGB; empty where it is not.
    """

    name: str
    source: str
    width: int
    height: int
    group: str
    focal: float | None = None
    centre: tuple[float, float] | None = None
    masked: bool = False
    own_mask: bool = False
    orientation: int = 1
    profile: str = ""


@dataclass(frozen=True)
class Preparation:
    """All working copies in natural name order, and why other files were left out, by name."""

    photos: tuple[Prepared, ...]
    skipped: dict[str, str] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """As JSON."""
        write_text(path, json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> Preparation:
        """Inverse of `write`."""
        table = read_json(path)
        photos = [Prepared(**row | {"centre": row["centre"] and tuple(row["centre"])}) for row in table["photos"]]
        return Preparation(tuple(photos), table["skipped"])


def prepare(job: PhotoJob, work: Path, progress: Progress) -> Preparation:
    """Write the working copies into ``work``.

    Raises:
        InputError: there are fewer than `LEAST` different photographs that can be read.
    """
    (work / PHOTOS).mkdir(exist_ok=True)
    (work / MASKS).mkdir(exist_ok=True)
    (work / OWN_MASKS).mkdir(exist_ok=True)
    skipped: dict[str, str] = {}
    sources = find_sources(job, skipped)
    seen: dict[str, str] = {}
    photos: list[Prepared] = []
    names = _working_names([source.name for source in sources])
    for index, source in enumerate(sources):
        progress(index, len(sources), f"reading {source.name}")
        try:
            whole = source.load()
            pixels = _reduced(whole, job.max_size)
            mask = _mask(source, whole, pixels)
        except InputError as error:
            skipped[source.name] = _reason(source.name, error)
            continue
        digest = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
        if digest in seen:
            skipped[source.name] = f"the same picture as {seen[digest]}"
            continue
        seen[digest] = source.name
        photos.append(_write(work, names[index], source, pixels, mask, job))
    _check(job, photos, skipped)
    return Preparation(tuple(photos), skipped)


def _working_names(names: Sequence[str]) -> list[str]:
    """Unique PNG names, as short as possible, of letters and digits that COLMAP's text files take for a name.

    They part words at spaces, and a line that begins with # is a comment.
    """
    plain = [re.sub(r"[^A-Za-z0-9._-]", "_", name) for name in names]
    candidates = ([Path(name).stem for name in plain], plain, [f"{index:04}-{name}" for index, name in enumerate(plain)])
    return next([f"{stem}.png" for stem in stems] for stems in candidates if len(set(stems)) == len(stems))


def _reduced(pixels: UInt8[np.ndarray, "h w c"], longest: int) -> UInt8[np.ndarray, "h w c"]:
    import torch

    height, width = pixels.shape[:2]
    if max(width, height) <= longest:
        return pixels
    unit = torch.ones(2, dtype=torch.float64)
    view = make_view(Camera(torch.eye(4, dtype=torch.float64), unit, unit, width, height), pixels, "", longest)
    alpha = [] if view.alpha is None else [view.alpha[..., None].numpy()]
    return np.concatenate([view.image.numpy(), *alpha], axis=-1)


def _write(
    work: Path,
    name: str,
    source: Source,
    pixels: UInt8[np.ndarray, "h w c"],
    mask: Bool[np.ndarray, "h w"] | None,
    job: PhotoJob,
) -> Prepared:
    from PIL import Image

    height, width = pixels.shape[:2]
    masked = pixels.shape[2] == 4 and int(pixels[..., 3].min()) < _OPAQUE
    write_picture(work / PHOTOS / name, Image.fromarray(pixels), compress_level=1)
    opaque = pixels[..., 3] >= _OPAQUE if masked else np.ones((height, width), dtype=bool)
    if mask is not None:
        write_picture(work / OWN_MASKS / f"{name}.png", Image.fromarray(255 * mask.astype(np.uint8)), compress_level=1)
        opaque, masked = opaque & mask, True
    write_picture(work / MASKS / f"{name}.png", Image.fromarray(255 * opaque.astype(np.uint8)), compress_level=1)
    focal = None if source.focal_share is None else source.focal_share * max(width, height)
    centre = None
    group = {"auto": f"{source.group} {width}x{height}", "single": f"{width}x{height}", "per-photo": name}[job.cameras]
    if source.camera is not None:
        camera = source.camera.resized(width, height)
        focal = float(camera.focal.mean())
        centre = (float(camera.principal_point[0]), float(camera.principal_point[1]))
    profile = "" if source.profile is None else readable(source.profile())
    own_mask = mask is not None
    return Prepared(name, source.name, width, height, group, focal, centre, masked, own_mask, source.orientation, profile)


def _mask(source: Source, whole: UInt8[np.ndarray, "h w c"], pixels: np.ndarray) -> Bool[np.ndarray, "height width"] | None:
    """Read the mask of a picture at the size of its working copy; a pixel counts where all of it did, to within a pixel.

    Args:
        source: the picture.
        whole: its pixels as they were read.
        pixels: those of the working copy.
    """
    if source.mask is None:
        return None
    mask = source.mask(whole.shape[1], whole.shape[0])
    if (height_width := pixels.shape[:2]) != mask.shape:
        from PIL import Image

        shrunk = Image.fromarray(255 * mask.astype(np.uint8)).resize(height_width[::-1], Image.Resampling.BOX)
        mask = np.asarray(shrunk) == 255
    if not mask.any():
        raise InputError("Its mask leaves no pixel.")
    return mask


def _reason(name: str, error: InputError) -> str:
    suffix = Path(name).suffix.lower()
    if suffix in PHONE and "cannot be read as a picture" in error.sentence:
        return f"nothing here decodes {suffix[1:].upper()}; convert it to JPEG, or `pip install pillow-heif`"
    return readable(error.sentence).rstrip(".")


def _check(job: PhotoJob, photos: list[Prepared], skipped: dict[str, str]) -> None:
    """Refuse photographs that no reconstruction is possible from."""
    if len(photos) < LEAST:
        _refuse(job.path, photos, skipped)
    sizes = {(photo.width, photo.height) for photo in photos}
    if job.cameras == "single" and len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise InputError(f"One camera cannot have taken pictures of {shown} pixels.", "Leave out --single-camera.")


def _refuse(folder: Path, photos: list[Prepared], skipped: dict[str, str]) -> NoReturn:
    names = ", ".join(photo.source for photo in photos)
    what = ("no photograph", f"only one photograph ({names})", f"only two photographs ({names})")[len(photos)]
    advice = f"A scene needs at least {LEAST}. {ADVICE}"
    if skipped:
        name, why = next(iter(skipped.items()))
        more = f" ({len(skipped)} files are left out)" if len(skipped) > 1 else ""
        raise InputError(f"{folder} has {what} that can be used; {name}: {why}{more}.", advice)
    below = [str(path) for path in sorted(folder.iterdir()) if has_photographs(path)]
    remedy = f"There are photographs in {below[0]}: name that folder." if below else advice
    if len(below) > 1:
        remedy = f"There are photographs in {', '.join(below)}: name one of these folders, or put all photographs into one."
    raise InputError(f"{folder} has {what}.", remedy)
