"""Settings of a photo import, and the hash that is its key."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, get_args

from invgraphics.config import fill
from invgraphics.errors import InputError
from invgraphics.scenes.pictures.images import PHONE, RAW, SUFFIXES, image_files
from invgraphics.scenes.pictures.masks import mask_of, masks_folder
from invgraphics.tables import parse_json
from invgraphics.text import sha256_of

SCHEMA = 3
DATABASE = "database.db"
"""COLMAP's data base of features and matches."""

QUALITY, TOP_VIEW = "quality.json", "top-view.png"
"""What is written beside ``images`` and ``sparse``; the first is written last, and means that the folder is whole."""

Matching = Literal["auto", "exhaustive", "sequential"]
Mapper = Literal["auto", "incremental", "global"]
Lens = Literal["auto", "pinhole", "radial", "opencv", "fisheye"]
Cameras = Literal["auto", "single", "per-photo"]

MODELS: dict[str, str] = {
    "pinhole": "SIMPLE_PINHOLE",
    "radial": "SIMPLE_RADIAL",
    "opencv": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
}
"""COLMAP's camera models by our names; ``auto`` begins with ``radial``."""

EXHAUSTIVE = 200
"""Most photographs of which every pair is matched by default: 20 thousand pairs."""

SECOND_TRY = 500
"""Most photographs of which every pair is matched where their neighbours in name order place few: 125 thousand pairs."""

_KINDS = SUFFIXES + PHONE + RAW


@dataclass(frozen=True)
class PhotoJob:
    """One reconstruction.

    Attributes:
        folder: of the photographs; or a data set that `invgraphics.scenes.open` reads, whose pictures (not poses) are taken.
        matching: which pairs are compared: all, each with those near it in name order, or ``auto`` by their number, and all
            where these place few.
        mapper: COLMAP's incremental mapper, or its global one (GLOMAP); ``auto``: the first, and the other where the result is
            suspicious or leaves out a tenth of the photographs.
        lens: what distortion is estimated; data sets are straight already. ``auto``: radial, and pinhole and opencv likewise.
        cameras: photographs of one size and one EXIF lens share their intrinsics, or all do, or none.
        max_size: longest side that pictures are reduced to, pixels.
        seed: of all random choices.
    """

    folder: str
    matching: Matching = "auto"
    mapper: Mapper = "auto"
    lens: Lens = "auto"
    cameras: Cameras = "auto"
    max_size: int = 1600
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("matching", Matching), ("mapper", Mapper), ("lens", Lens), ("cameras", Cameras)):
            if getattr(self, name) not in get_args(known):
                raise InputError(f"'{name}' cannot be '{getattr(self, name)}'.", f"Expected: {', '.join(get_args(known))}.")
        if self.max_size < 64:
            raise InputError(f"The largest size cannot be {self.max_size} pixels.", "Expected: at least 64.")
        if self.seed < 0:
            raise InputError(f"The seed cannot be {self.seed}.", "Expected: 0 or more.")

    @property
    def path(self) -> Path:
        """The folder."""
        return Path(self.folder)

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def parse(text: str) -> PhotoJob:
        """Inverse of `text`."""
        return fill(PhotoJob, parse_json(text, "the job"))

    def key(self) -> str:
        """Hash of the settings, the photographs' names, sizes and dates, and the versions of COLMAP and of the decoders.

        Not of the folder's name, which may be spelled from anywhere.
        """
        return self._hash(self._settings())

    def matches_key(self) -> str:
        """Hash of all that features and matches depend on: of `key`, neither the mapper nor, but for fisheyes, the lens.

        Pairs of known focal length are verified on the plane z = 1, which a fisheye's pixels reach in another way.
        """
        settings = {name: value for name, value in self._settings().items() if name not in ("mapper", "lens")}
        return self._hash(settings | {"fisheye": self.lens == "fisheye"})

    def _settings(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name != "folder"}

    def _hash(self, settings: dict[str, Any]) -> str:
        files = [(path, path.stat()) for path in files_read(self.path)]
        listing = [(os.path.relpath(path, self.path), state.st_size, state.st_mtime_ns) for path, state in files]
        content = [SCHEMA, settings, listing, *map(_version, ("pycolmap", "pillow", "pillow-heif"))]
        return sha256_of(content)[:16]


def _version(package: str) -> str | None:
    """Version of an installed package; ``None`` without it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def files_read(folder: Path) -> list[Path]:
    """List the files that an import of ``folder`` may read: photographs and their masks; of a data set all but hidden ones."""
    if not image_files(folder):
        return sorted(path for path in folder.rglob("*") if _counts(path, folder))
    photographs = sorted(path for path in folder.iterdir() if path.suffix.lower() in _KINDS and _counts(path, folder))
    masks = masks_folder(folder)
    found = [] if masks is None else [mask_of(path.name, masks) for path in photographs]
    return photographs + [mask for mask in found if mask is not None]


def _counts(path: Path, folder: Path) -> bool:
    """Whether a path is a file, and no hidden one nor a system's list of a folder."""
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    return not hidden and path.name.lower() not in ("thumbs.db", "desktop.ini") and path.is_file()
