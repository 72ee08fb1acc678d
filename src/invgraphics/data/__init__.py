"""Where the packaged data lives: scene descriptions, recipes and studies, which are data and travel inside the wheel."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from invgraphics.errors import InputError, did_you_mean

Kind = Literal["scenes", "renderers", "studies"]


def find(kind: Kind, name: str = "") -> Path:
    """Path of the packaged ``kind`` folder, or of the entry ``name`` in it.

    An installed wheel carries the folders beside this file. A checkout has them at the repository's root; the copies that an
    editable install makes are not read.

    Raises:
        InputError: there is no such entry; the ones there are, are listed.
    """
    folder = next((root / kind for root in _roots() if (root / kind).is_dir()), None)
    if folder is None:
        raise InputError(f"The packaged folder '{kind}' is missing.", "Reinstall invgraphics, or run from its repository.")
    if name and not (folder / name).exists():
        known = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
        raise InputError(
            f"There is no '{name}' among the {kind}.{did_you_mean(name, known)}", f"Known {kind}: {', '.join(known) or 'none'}."
        )
    return folder / name


def has_scene(name: str) -> bool:
    """Whether a scene of this name is built in."""
    return (find("scenes") / name / "scene.toml").is_file()


def has_method(name: str) -> bool:
    """Whether a method of this name, ``renderer/recipe``, is built in."""
    return (find("renderers") / f"{name}.toml").is_file()


def _roots() -> tuple[Path, ...]:
    here = Path(__file__).resolve()
    return here.parent, here.parents[3]
