"""Images and links of a page: colour-mapped PNGs, and files copied so that links stay inside its folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from invgraphics import locks
from invgraphics.errors import InputError
from invgraphics.files import copy_file, write_picture
from invgraphics.report.data.redact import Redactor
from invgraphics.runs.inside import inside

LOCK = ".report.lock"
"""Lock file of a report's folder; a study's folder has another one, as its report may be written while it runs."""
MASKED = 255
"""Palette entry of transparent pixels."""


@dataclass(frozen=True)
class Folder:
    """Output folder of a report; all files that its page shows lie inside.

    Attributes:
        root: where ``index.html`` lies.
        part: name of the part of the page whose files these are; empty where the page has only one.
        redactor: cleans what is copied, for a public report; ``None`` for a private one.
    """

    root: Path
    part: str = ""
    redactor: Redactor | None = None

    @property
    def figures(self) -> Path:
        """Where this part's plots and maps go."""
        return self.root / "figures" / self.part

    def url(self, path: Path) -> str:
        """The relative, quoted link to a file inside the folder."""
        return quote(Path(os.path.relpath(path.resolve(), self.root.resolve())).as_posix())

    def publish(self, source: Path, name: str, place: str) -> str:
        """A relative link to a file, which is copied when it lies outside the report's folder or must be cleaned.

        Args:
            source: folder of a run, of a truth or of a study.
            name: of the file in it.
            place: of the copy, in this part of the report.

        Raises:
            InputError: there is no such file, or it or its place lies outside its folder.
        """
        path = inside(source, name)
        if not path.is_file():
            raise InputError(f"'{path}' is missing.", "Fit the run again, or leave it out of the report.")
        if self.redactor is None and path.resolve().is_relative_to(self.root.resolve()):
            return self.url(path)
        copy = inside(self.root, self.part, place)
        if self.redactor is not None:
            self.redactor.copy(path, copy)
        else:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy_file(path, copy)
        return self.url(copy)


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Create a report's folder and lock it for writing.

    Raises:
        InputError: it cannot be written, or another process is writing it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with locks.locked(out, out / LOCK):
            yield
    except OSError as error:
        raise InputError(f"The report cannot be written to '{out}': {error}.", "Choose another --out.") from error


def save_scalar(path: Path, unit: Float[ndarray, "h w"], mask: Bool[ndarray, "h w"], colours: str) -> None:
    """Write values in [0, 1] through a named Matplotlib colour map, as a palette PNG that is transparent outside ``mask``."""
    import matplotlib as mpl
    from PIL import Image

    table = mpl.colormaps[colours](np.linspace(0, 1, MASKED))[:, :3]
    palette = np.zeros((256, 3), np.uint8)
    palette[:MASKED] = np.round(table * 255)
    index = np.round(np.nan_to_num(unit).clip(0, 1) * (MASKED - 1)).astype(np.uint8)
    image = Image.fromarray(np.where(mask, index, np.uint8(MASKED)))
    image.putpalette(palette.tobytes())
    _write(image, path, transparency=MASKED)


def save_normals(path: Path, normals: Float[ndarray, "h w 3"], mask: Bool[ndarray, "h w"]) -> None:
    """Write unit normals as colours (n + 1) / 2, transparent outside ``mask``."""
    from PIL import Image

    colour = np.round((np.nan_to_num(normals).clip(-1, 1) + 1) / 2 * 255)
    rgba = np.where(mask[..., None], np.concatenate([colour, np.full_like(colour[..., :1], 255)], axis=-1), 0)
    _write(Image.fromarray(rgba.astype(np.uint8), "RGBA"), path)


def _write(image: Any, path: Path, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, image, optimize=True, **options)


def gradient(colours: str, stops: int = 9) -> str:
    """A CSS gradient of a named Matplotlib colour map, for legends."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return f"linear-gradient(90deg,{','.join(to_hex(colour) for colour in mpl.colormaps[colours](np.linspace(0, 1, stops)))})"
