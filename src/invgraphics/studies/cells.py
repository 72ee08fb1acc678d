"""Planning of a study's cells as runs: settings resolved and checked, folders named."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from invgraphics import plugins
from invgraphics.errors import InputError
from invgraphics.experiments.identity import cell_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import AblateRequest, FitRequest
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RUNS
from invgraphics.scenes.open import is_rendered
from invgraphics.studies.factors import BUDGET, SIZE, in_scope, path_of
from invgraphics.studies.study import Cell, Study
from invgraphics.text import slug

LONGEST_NAME = 100
"""Characters of a run's folder name, its hash left out."""


@dataclass(frozen=True)
class Planned:
    """A cell and its run, which several cells may share.

    Attributes:
        cell: of the study.
        job: the run, in its own folder.
    """

    cell: Cell
    job: Job

    @property
    def fit(self) -> FitRequest:
        """The run's request."""
        return self.job.request

    @property
    def method(self) -> Method:
        """The run's resolved recipe."""
        return self.job.method

    @property
    def id(self) -> str:
        """Name of the run's folder."""
        return self.job.folder.root.name

    @property
    def label(self) -> str:
        """Label ``--cells`` and known deviations match against: method, scene@size, other levels, budget and seed."""
        size = self.fit.size if not isinstance(self.fit.size, tuple) else "x".join(map(str, self.fit.size))
        where = self.cell.scene_name if size is None else f"{self.cell.scene_name}@{size}"
        return " ".join([self.cell.method, where, *_levels(self.cell), self.fit.budget, f"seed={self.cell.seed}"])


def make_plan(study: Study, request: AblateRequest) -> list[Planned]:
    """Resolve every cell to its run, and check all settings.

    Raises:
        InputError: unknown method, key, protocol or device, or a level that does not fit; the sentence names the cell.
    """
    methods: dict[tuple[Any, ...], Method] = {}
    made = {path.name.rpartition("-")[2]: path.name for path in sorted((Path(request.out) / RUNS).glob("*-*"))}
    folders: dict[str, Path] = {}  # a run that several cells share is named after the first
    plan = []
    for cell in study.expand():
        fit = study.fit_request(cell, request)
        fit = fit if is_rendered(fit.scene) else replace(fit, spp=None)
        key = (cell.method, fit.preset, fit.budget, fit.recipe_overrides)
        try:
            job = Job.of(fit, methods.get(key))
            plugins.check_importable(job.method.table, job.method.name)
        except InputError as error:
            raise _in_cell(cell, error) from error
        methods[key] = job.method
        definition = cell_digest(job)
        short = definition[:10]
        # The readable part differs where factors were added or reordered; the fit does not.
        folder = folders.setdefault(definition, Path(fit.out) / RUNS / made.get(short, f"{_readable(cell)}-{short}"))
        plan.append(Planned(cell, replace(job, request=replace(fit, out=str(folder)))))
    return plan


def select(plan: list[Planned], request: AblateRequest) -> list[Planned]:
    """Filter a plan by ``--cells`` and ``--most-seconds``; budgets in steps have no seconds to compare.

    Raises:
        InputError: nothing is left.
    """
    most = request.most_seconds
    kept = [
        planned
        for planned in plan
        if (request.cells is None or fnmatchcase(planned.label, request.cells))
        and (most is None or (planned.job.budget.seconds or 0) <= most)
    ]
    if not kept:
        remedy = f"A cell's label reads '{plan[0].label}'; a * stands for any characters."
        raise InputError("No cell of the study is left to run.", remedy)
    return kept


def _in_cell(cell: Cell, error: InputError) -> InputError:
    """Prefix an error with the cell that caused it."""
    levels = {name: level for name, level in cell.levels.items() if in_scope(name, cell.method)}
    where = f"{cell.method} with {', '.join(f'{name} = {level}' for name, level in levels.items())}" if levels else cell.method
    remedy = error.remedy
    if error.sentence.startswith("Unknown key"):
        remedy += '\nA key that only some methods have names them: "METHOD:key", where a * stands for any characters.'
    return InputError(f"{where}: {error.sentence}", remedy)


def _levels(cell: Cell, without: tuple[str, ...] = (BUDGET, SIZE)) -> list[str]:
    """Format the levels in scope of the cell's method, except ``without``, as ``key=level`` with the key's last part."""
    scoped = {path_of(name): level for name, level in cell.levels.items() if in_scope(name, cell.method)}
    return [f"{path.rpartition('.')[2]}={level}" for path, level in scoped.items() if path not in without]


def _readable(cell: Cell) -> str:
    """Human-readable part of a run's folder name."""
    words = [cell.scene_name, slug(cell.method), *_levels(cell, ()), f"seed={cell.seed}"]
    return re.sub(r"[^\w.=+-]+", "-", "-".join(words))[:LONGEST_NAME]
