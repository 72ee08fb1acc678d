"""Working copies of photographs: upright, 8 bits, of a bounded size, each different from all others, grouped by camera."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool, UInt8

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.files import write_picture, write_text
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.photos.job import PhotoJob
from invgraphics.scenes.pictures import png
from invgraphics.scenes.pictures.images import SUFFIXES, UNREADABLE, image_files, read_pixels
from invgraphics.scenes.pictures.views import make_view
from invgraphics.scenes.process import Progress
from invgraphics.tables import read_json

PHOTOS, MASKS, OWN_MASKS, PREPARED = "photos", "masks", "own-masks", "prepared.json"

PHONE = (".heic", ".heif", ".avif")
"""Read where Pillow has a decoder for them."""

RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Sensor data: what Pillow finds in some of them is a thumbnail."""

ADVICE = "Take 20 to 60 sharp photographs while walking around the scene, each overlapping its neighbours by two thirds."

FOCAL_RANGE = (0.2, 10.0)  # of the longest side; beyond it an EXIF focal length is a mistake
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
        centre: principal point, where the data set knows it.
        masked: whether no features are looked for in parts of it: where it is transparent, or a data set masks it.
        own_mask: whether it has a mask of a data set, which the scene keeps.
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


@dataclass(frozen=True, eq=False)
class _Source:
    """One picture, not read yet: its name, group, known intrinsics (of what ``load`` returns) and the data set's mask."""

    name: str
    load: Callable[[], UInt8[np.ndarray, "h w c"]]
    group: str
    focal_share: float | None = None  # focal length over the longest side
    camera: Camera | None = None
    mask: Bool[np.ndarray, "h w"] | None = None


def prepare(job: PhotoJob, work: Path, progress: Progress) -> Preparation:
    """Write the working copies into ``work``.

    Raises:
        InputError: there are fewer than two different photographs that can be read.
    """
    (work / PHOTOS).mkdir(exist_ok=True)
    (work / MASKS).mkdir(exist_ok=True)
    (work / OWN_MASKS).mkdir(exist_ok=True)
    skipped: dict[str, str] = {}
    sources = _data_set(job) if not image_files(job.path) and _is_data_set(job.path) else _files(job.path, skipped)
    seen: dict[str, str] = {}
    photos: list[Prepared] = []
    names = _working_names([source.name for source in sources])
    for index, source in enumerate(sources):
        progress(index, len(sources), f"reading {source.name}")
        try:
            pixels = _reduced(source.load(), job.max_size)
        except InputError as error:
            skipped[source.name] = _reason(source.name, error)
            continue
        digest = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
        if digest in seen:
            skipped[source.name] = f"the same picture as {seen[digest]}"
            continue
        seen[digest] = source.name
        photos.append(_write(work, names[index], source, pixels, job))
    _check(job, photos, skipped)
    return Preparation(tuple(photos), skipped)


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key: digits count as numbers, so that photograph 9 comes before photograph 10."""
    import re

    return [(int(part), "") if part.isdigit() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def _working_names(names: Sequence[str]) -> list[str]:
    """PNG names without spaces (which part the words of COLMAP's text files), told apart as simply as possible."""
    plain = ["_".join(name.split()) for name in names]
    candidates = ([Path(name).stem for name in plain], plain, [f"{index:04}-{name}" for index, name in enumerate(plain)])
    return next([f"{stem}.png" for stem in stems] for stems in candidates if len(set(stems)) == len(stems))


def _files(folder: Path, skipped: dict[str, str]) -> list[_Source]:
    _register_decoders()
    found = []
    for path in sorted(folder.iterdir(), key=lambda path: natural(path.name)):
        suffix = path.suffix.lower()
        if suffix in RAW:
            skipped[path.name] = "raw sensor data; export it as JPEG or PNG"
        elif suffix in SUFFIXES + PHONE and path.is_file() and not path.name.startswith("._"):
            exif = _exif(path)
            group = "/".join(str(exif.get(tag, "")) for tag in _LENS_TAGS)
            found.append(_Source(path.name, lambda path=path: read_pixels(path), group, _focal_share(path)))
    return found


_LENS_TAGS = (0x010F, 0x0110, 0x920A, 0xA405, 0xA434)  # make, model, focal length, its 35 mm equivalent, lens


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


def _focal_share(path: Path) -> float | None:
    """Focal length over the longest side, as COLMAP reads it from EXIF (35 mm equivalent, focal plane, sensor data base)."""
    from invgraphics.scenes.colmap_library import pycolmap

    try:
        camera = pycolmap.infer_camera_from_image(str(path))
    except (ValueError, RuntimeError):
        return None
    share = camera.mean_focal_length() / max(camera.width, camera.height)
    return share if camera.has_prior_focal_length and FOCAL_RANGE[0] < share < FOCAL_RANGE[1] else None


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


def _data_set(job: PhotoJob) -> list[_Source]:
    """A data set's pictures as fits see them: straight, with their alpha, no larger than they are worked with."""
    from invgraphics.scenes.open import find_loader

    scene = find_loader(job.path).load(job.path, SceneOptions(size=job.max_size, test_views=None))
    sources: list[_Source] = []
    for split in ("train", "val", "test"):
        for view in getattr(scene, split):
            name = Path(view.name).name
            label = name if Path(name).suffix.lower() in SUFFIXES else f"{split}-{name}"

            def load(view: Any = view) -> UInt8[np.ndarray, "h w c"]:
                image = (view.colour() * 255 + 0.5).byte().numpy()
                alpha = [] if view.alpha is None else [(view.opacity() * 255 + 0.5).byte().numpy()[..., None]]
                return np.concatenate([image, *alpha], axis=-1)

            mask = None if view.mask is None else view.mask.numpy()
            sources.append(_Source(label, load, _calibration(view.camera), camera=view.camera, mask=mask))
    return sorted(sources, key=lambda source: natural(source.name))


def _calibration(camera: Camera) -> str:
    """Name of a group of cameras of one calibration: focal lengths equal to a thousandth, principal points to a pixel."""
    return "data set f={:.3g},{:.3g} c={:.0f},{:.0f}".format(*camera.focal.tolist(), *camera.principal_point.tolist())


def _reduced(pixels: UInt8[np.ndarray, "h w c"], longest: int) -> UInt8[np.ndarray, "h w c"]:
    import torch

    height, width = pixels.shape[:2]
    if max(width, height) <= longest:
        return pixels
    unit = torch.ones(2, dtype=torch.float64)
    view = make_view(Camera(torch.eye(4, dtype=torch.float64), unit, unit, width, height), pixels, "", longest)
    alpha = [] if view.alpha is None else [view.alpha[..., None].numpy()]
    return np.concatenate([view.image.numpy(), *alpha], axis=-1)


def _write(work: Path, name: str, source: _Source, pixels: UInt8[np.ndarray, "h w c"], job: PhotoJob) -> Prepared:
    from PIL import Image

    height, width = pixels.shape[:2]
    masked = pixels.shape[2] == 4 and int(pixels[..., 3].min()) < _OPAQUE
    write_picture(work / PHOTOS / name, Image.fromarray(pixels), compress_level=1)
    opaque = pixels[..., 3] >= _OPAQUE if masked else np.ones((height, width), dtype=bool)
    if source.mask is not None:
        counts = _at_size(source.mask, width, height)
        write_picture(work / OWN_MASKS / f"{name}.png", Image.fromarray(255 * counts.astype(np.uint8)), compress_level=1)
        opaque, masked = opaque & counts, True
    write_picture(work / MASKS / f"{name}.png", Image.fromarray(255 * opaque.astype(np.uint8)), compress_level=1)
    focal = None if source.focal_share is None else source.focal_share * max(width, height)
    centre = None
    group = {"auto": f"{source.group} {width}x{height}", "single": f"{width}x{height}", "per-photo": name}[job.cameras]
    if source.camera is not None:
        camera = source.camera.resized(width, height)
        focal = float(camera.focal.mean())
        centre = (float(camera.principal_point[0]), float(camera.principal_point[1]))
    return Prepared(name, source.name, width, height, group, focal, centre, masked, source.mask is not None)


def _at_size(mask: Bool[np.ndarray, "h w"], width: int, height: int) -> Bool[np.ndarray, "height width"]:
    """A mask at another size; a pixel counts where all of it did, to within a pixel of the mask."""
    if mask.shape == (height, width):
        return mask
    from PIL import Image

    shrunk = Image.fromarray(255 * mask.astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(shrunk) == 255


def _reason(name: str, error: InputError) -> str:
    suffix = Path(name).suffix.lower()
    if suffix in PHONE:
        return f"nothing here decodes {suffix[1:].upper()}; convert it to JPEG, or `pip install pillow-heif`"
    return error.sentence.rstrip(".")


def _check(job: PhotoJob, photos: list[Prepared], skipped: dict[str, str]) -> None:
    """Refuse photographs that no reconstruction is possible from."""
    if len(photos) < 2:
        _refuse(job.path, photos, skipped)
    sizes = {(photo.width, photo.height) for photo in photos}
    if job.cameras == "single" and len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise InputError(f"One camera cannot have taken pictures of {shown} pixels.", "Leave out --single-camera.")


def _refuse(folder: Path, photos: list[Prepared], skipped: dict[str, str]) -> NoReturn:
    what = f"only one photograph ({photos[0].source})" if photos else "no photograph"
    if skipped:
        name, why = next(iter(skipped.items()))
        more = f" ({len(skipped)} files are left out)" if len(skipped) > 1 else ""
        raise InputError(f"{folder} has {what} that can be used; {name}: {why}{more}.", ADVICE)
    below = next((path for path in sorted(folder.iterdir()) if image_files(path)), None)
    raise InputError(
        f"{folder} has {what}.", ADVICE if below is None else f"There are photographs in {below}: name that folder."
    )
