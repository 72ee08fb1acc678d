"""The cells of a study as runs: settings resolved and checked, folders named."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.experiments.build import device_of, training_data
from invgraphics.experiments.identity import define
from invgraphics.experiments.recipe import Method, requested_method
from invgraphics.experiments.recorder import Cadence
from invgraphics.experiments.request import AblateRequest, FitRequest, slug
from invgraphics.experiments.study import Cell, Study, in_scope, path_of
from invgraphics.metrics.protocols import protocol_named

LONGEST_NAME = 100
"""Characters of a run's folder name, its hash left out."""


@dataclass(frozen=True)
class Planned:
    """A cell and the run that answers it; several cells may share a run.

    Attributes:
        cell: of the study.
        fit: the run, in its own folder.
        method: its resolved recipe.
    """

    cell: Cell
    fit: FitRequest
    method: Method

    @property
    def id(self) -> str:
        """Name of the run's folder."""
        return Path(self.fit.out).name

    @property
    def kind(self) -> tuple[str, str]:
        """Method and preset, which decide what a run costs."""
        return self.method.name, self.method.preset


def make_plan(study: Study, request: AblateRequest) -> list[Planned]:
    """Every cell with its run, all settings checked.

    Raises:
        InputError: unknown method, key, protocol or device, or a level that does not fit; the sentence names the cell.
    """
    protocol_named(study.protocol)
    device_of(request.device)
    Cadence.parse(request.checkpoint_every)
    methods: dict[tuple[str, tuple[str, ...], str], Method] = {}
    folders: dict[str, Path] = {}  # a run that several cells share is named after the first
    plan = []
    for cell in study.expand():
        fit = study.fit_request(cell, request)
        key = (cell.method, fit.recipe_overrides, fit.budget)
        try:
            if key not in methods:
                methods[key] = requested_method(cell.method, fit)
            training_data(fit)
        except InputError as error:
            raise _in_cell(cell, error) from error
        definition = define(fit, methods[key])
        folder = folders.setdefault(definition, Path(fit.out) / "runs" / f"{_readable(cell)}-{definition[:10]}")
        plan.append(Planned(cell, replace(fit, out=str(folder)), methods[key]))
    return plan


def _in_cell(cell: Cell, error: InputError) -> InputError:
    """An error with the cell that it came from."""
    levels = {name: level for name, level in cell.levels.items() if in_scope(name, cell.method)}
    where = f"{cell.method} with {', '.join(f'{name} = {level}' for name, level in levels.items())}" if levels else cell.method
    remedy = error.remedy
    if error.sentence.startswith("Unknown key"):
        remedy += '\nA key that only some methods have names them: "METHOD:key", where a * stands for any characters.'
    return InputError(f"{where}: {error.sentence}", remedy)


def _readable(cell: Cell) -> str:
    """What a person sees of a run's folder name."""
    scoped = {name: level for name, level in cell.levels.items() if in_scope(name, cell.method)}
    levels = [f"{path_of(name).rpartition('.')[2]}={level}" for name, level in scoped.items()]
    words = [Path(cell.scene).resolve().name, slug(cell.method), *levels, f"seed={cell.seed}"]
    return re.sub(r"[^\w.=+-]+", "-", "-".join(words))[:LONGEST_NAME]
