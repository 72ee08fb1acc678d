"""Small computations that a study sets beside its fits: a known case, where a single effect can be seen alone.

An analysis is a function that returns `Analysis`; ``study.toml`` names it, and its curves are kept as JSON for the report.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from invgraphics.errors import InputError

ANALYSES = {
    "affine-projection": "invgraphics.studies.approximations:affine_projection",
    "field-of-view": "invgraphics.studies.approximations:field_of_view",
    "sorting-by-centre": "invgraphics.studies.approximations:sorting_by_centre",
    "opacity-convention": "invgraphics.studies.approximations:opacity_convention",
}
"""Name -> ``module:function``."""
FOLDER = "analyses"


@dataclass(frozen=True)
class Curve:
    """One line of a plot: ``y`` over ``x``."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class Analysis:
    """What was computed, in words and as curves.

    Attributes:
        title: a few words.
        sentence: what a reader should take away; the numbers in it are computed.
        x: name and unit of the horizontal axis.
        y: of the vertical axis.
        curves: all of them.
        logarithmic: whether the vertical axis is.
    """

    title: str
    sentence: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False


def check_analyses(names: Sequence[str], where: str) -> None:
    """Refuse names that are no analyses.

    Raises:
        InputError: one is unknown; the known ones are listed.
    """
    for name in names:
        if name not in ANALYSES:
            raise InputError(f"{where}: there is no analysis '{name}'.", f"Known analyses: {', '.join(ANALYSES)}.")


def write_analyses(names: Sequence[str], root: Path) -> None:
    """Compute what is missing below ``root``, or was computed by other code."""
    from invgraphics.experiments.environment import code_version
    from invgraphics.runs.folder import RunFolder

    if not names:
        return
    folder = RunFolder(root / FOLDER)
    folder.create()
    for name in names:
        file = f"{name}.json"
        if (folder.root / file).is_file() and folder.read_json(file).get("code") == code_version():
            continue
        module, _, function = ANALYSES[name].partition(":")
        compute: Callable[[], Analysis] = getattr(importlib.import_module(module), function)
        folder.write_json(file, {"schema": 1, "name": name, "code": code_version(), **asdict(compute())})
