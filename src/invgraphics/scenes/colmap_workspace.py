"""COLMAP workspaces: choice among models, and search for their photographs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.scenes.colmap_sizes import check_sizes, names_in_text
from invgraphics.scenes.layout import IMAGE_FOLDERS, is_image_folder
from invgraphics.scenes.pictures.images import file_exists, image_files

PLACES = ("sparse/0", "sparse", "sparse/*", "colmap/sparse", "colmap/sparse/*", ".", "[0-9]", "[0-9][0-9]")
UNDISTORTED = ("dense/sparse", "dense/*/sparse", "undistorted/sparse", "[0-9]/sparse", "dense/*", "dense")
"""Where models are looked for, the usual places first; those of the second tuple come with undistorted photographs."""


@dataclass(frozen=True, eq=False)
class Model:
    """A COLMAP model and the folder of its photographs.

    Attributes:
        folder: holds ``cameras.bin`` or ``cameras.txt``.
        reconstruction: a ``pycolmap.Reconstruction``.
        images: the photographs' folder; ``None`` where no photograph of the model was found.
        present: registered photographs whose files exist.
        note: which model was chosen among several, in words; empty where there is only one.
    """

    folder: Path
    reconstruction: Any
    images: Path | None
    present: int
    note: str = ""

    @property
    def registered(self) -> list[Any]:
        """Its ``pycolmap.Image`` objects with a pose, sorted by name."""
        return sorted((image for image in self.reconstruction.images.values() if image.has_pose), key=lambda image: image.name)


def model_folders(path: Path) -> list[Path]:
    """List the folders of COLMAP models in the workspace that ``path`` is, or is a folder of."""
    given = _absolute(path)
    root = given.parent if is_image_folder(given) and not _holds_model(path) else path
    found: dict[Path, Path] = {}
    for place in (*PLACES, *UNDISTORTED):
        for folder in sorted(root.glob(place)) if place != "." else [root]:
            if _holds_model(folder):
                found.setdefault(folder.resolve(), folder)
    return list(found.values())


def find_model(path: Path) -> Model:
    """Select the model with the most photographs on disk; of equal ones the first in the order of `PLACES`.

    If ``path`` is a folder of photographs (``images_4``), those in it are taken, and a model of theirs.

    Raises:
        InputError: there is no model, none can be read, none registers an image, or no photograph of any exists.
    """
    folders = model_folders(path)
    if not folders:
        raise InputError(
            f"{path} has no COLMAP model.", f"Looked for cameras.bin or cameras.txt in {', '.join((*PLACES, *UNDISTORTED))}."
        )
    given = _absolute(path)
    models, failures = [], []
    for folder in folders:
        try:
            models.append(_read(folder, given))
        except InputError as error:
            failures.append((folder, error))
    if not models:
        raise failures[0][1]
    # Of equal ones, the first.
    chosen = max(models, key=lambda model: (_is_given(model, given), model.present, len(model.registered)))
    if not chosen.registered:
        raise InputError(f"{chosen.folder} registers no image.")
    if chosen.images is None:
        names, looked = [image.name for image in chosen.registered], [*_image_folders(chosen.folder)]
        raise InputError(
            f"None of the {len(names)} pictures that {chosen.folder} lists exists.",
            f"Looked for '{names[0]}' in {', '.join(map(str, looked))}.",
        )
    others = [f"{_place(model.folder, path)} ({_count(model)})" for model in models if model is not chosen]
    others += [f"{_place(folder, path)} (cannot be read)" for folder, _ in failures]
    why = "has those that were asked for" if _is_given(chosen, given) else "has the most photographs"
    note = f"{_place(chosen.folder, path)} ({_count(chosen)}) {why}; not taken: {', '.join(others)}"
    return replace(chosen, note=note if others else "")


def _absolute(path: Path) -> Path:
    """Absolute path through links as they are named: photographs lie beside a link to a model, not beside what it leads to."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def _place(folder: Path, path: Path) -> str:
    inner, outer = folder.resolve(), path.resolve()
    return str(inner.relative_to(outer)) if inner.is_relative_to(outer) else str(inner)


def _count(model: Model) -> str:
    listed = len(model.registered)
    return f"{listed} photographs" if model.present == listed else f"{model.present} of {listed} photographs are there"


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def _is_given(model: Model, given: Path) -> bool:
    """Whether a model's photographs are those that were asked for by their folder."""
    return model.images is not None and is_image_folder(given) and _absolute(model.images) == given


def _read(folder: Path, given: Path) -> Model:
    from invgraphics.scenes.colmap_library import pycolmap

    check_sizes(folder)
    names_of = names_in_text(folder / "images.txt")
    try:
        reconstruction = pycolmap.Reconstruction(str(folder))
    except (ValueError, IndexError, RuntimeError, MemoryError) as error:
        raise InputError(f"The COLMAP model {folder} cannot be read: {str(error).splitlines()[0]}.") from error
    for number, name in names_of.items():
        if number in reconstruction.images:
            reconstruction.images[number].name = name
    bare = Model(folder, reconstruction, None, 0)
    try:
        names = [image.name for image in bare.registered]
    except UnicodeDecodeError as error:
        raise InputError(f"The COLMAP model {folder} has an image whose name is no text in UTF-8.", "Rename it.") from error
    candidates = [replace(bare, images=images, present=_present(images, names)) for images in _image_folders(folder)]
    asked = [model for model in candidates if model.present and _is_given(model, given)]
    if not asked and is_image_folder(given) and any(_is_given(model, given) for model in candidates):
        asked = [_renamed(bare, given)] if image_files(given) else []
    fullest = max(asked or candidates, key=lambda model: model.present, default=bare)  # of equal ones, the nearest
    return fullest if fullest.present else bare


def _renamed(model: Model, folder: Path) -> Model:
    """The model with the photographs of a folder in which they have other names, in the order of names (LLFF's scaled copies).

    Raises:
        InputError: there are more or fewer than the model lists.
    """
    images, files = sorted(model.reconstruction.images.values(), key=lambda image: image.name), sorted(image_files(folder))
    if len(images) != len(files):
        what = f"{folder} has none of the {len(images)} photographs that {model.folder} lists, and {len(files)} of other names."
        raise InputError(what, f"The first one listed is '{images[0].name}'.")
    for image, file in zip(images, files, strict=True):
        image.name = file.name
    return replace(model, images=folder, present=len(model.registered))


def _present(folder: Path, names: Sequence[str]) -> int:
    return sum(file_exists(folder / name) for name in names) if folder.is_dir() else 0


def parents_in_workspace(model: Path) -> list[Path]:
    """A model's folder, and those above it up to the one that holds ``sparse`` or ``colmap/sparse``."""
    base = _absolute(model)
    bases = [base]
    if base.name.isdecimal() or base.parent.name == "sparse":  # sparse/0, sparse/aligned
        base = base.parent
        bases.append(base)
    for name in ("sparse", "colmap"):
        if base.name == name:
            base = base.parent
            bases.append(base)
    return bases


def _image_folders(model: Path) -> Iterator[Path]:
    """List folders that may hold a model's photographs, nearest first: below it, or beside it and its parents.

    The search ends at the folder that holds ``sparse``: photographs farther up are not those of an undistorted model.
    """
    bases = parents_in_workspace(model)
    for each in bases:
        yield from (each / name for name in IMAGE_FOLDERS)
        yield each
    if len(bases) == 1:  # a model in a folder of any name: photographs beside it
        yield bases[0].parent / IMAGE_FOLDERS[0]
