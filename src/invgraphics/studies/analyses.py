"""Analyses of a study beside its fits: computations on known cases that isolate a single effect.

An analysis is a function that returns an `invgraphics.runs.analysis.Analysis`; ``study.toml`` names it, and its curves are kept
for the report.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.runs.analysis import Analysis, analysis_path

ANALYSES = {
    "affine-projection": "invgraphics.studies.approximations:affine_projection",
    "depth-over-width": "invgraphics.studies.surfaces:depth_over_width",
    "field-of-view": "invgraphics.studies.approximations:field_of_view",
    "sorting-by-centre": "invgraphics.studies.approximations:sorting_by_centre",
    "opacity-convention": "invgraphics.studies.approximations:opacity_convention",
}
"""Name -> ``module:function``."""


def check_analyses(names: Sequence[str], where: str) -> None:
    """Check that all names are registered analyses.

    Raises:
        InputError: one is unknown; the known ones are listed.
    """
    for name in names:
        if name not in ANALYSES:
            raise InputError(f"{where}: there is no analysis '{name}'.", f"Known analyses: {', '.join(ANALYSES)}.")


def write_analyses(names: Sequence[str], root: Path) -> None:
    """Compute and write the analyses that are missing below ``root`` or were computed by a different code version."""
    from invgraphics.experiments.environment import code_version
    from invgraphics.runs.folder import RunFolder

    for name in names:
        path = analysis_path(root, name)
        if path.is_file() and Analysis.read(path).code == code_version():
            continue
        module, _, function = ANALYSES[name].partition(":")
        compute: Callable[[], Analysis] = getattr(importlib.import_module(module), function)
        RunFolder(path.parent).create()
        replace(compute(), name=name, code=code_version()).write(path)
