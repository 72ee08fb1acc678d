"""Comparison of several methods on one scene, each fitted in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Unpack

from invgraphics.api.keeping import ReuseOptions, reopenable_scene
from invgraphics.api.loading import (
    MethodLike,
    as_scene,
    data_overrides,
    listed,
    load_run,
    name_of,
    whole_seeds,
)
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments import compare as comparing
from invgraphics.experiments.display import ScoreTable, table_html
from invgraphics.experiments.request import CompareRequest
from invgraphics.experiments.session import FolderRun
from invgraphics.recipes.recipe import Method, expand
from invgraphics.report.build import build_report
from invgraphics.report.data.comparison import Comparison, read_comparison
from invgraphics.report.statistics.summary import Summary, summarise
from invgraphics.runs.comparison import Failure
from invgraphics.runs.folder import RunFolder


class ComparisonResult:
    """A finished comparison; in a notebook, its table.

    Args:
        folder: that `compare` wrote.

    Attributes:
        folder: of the report and its runs.
        page: the report, an HTML file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.page = folder, build_report(folder)

    @cached_property
    def record(self) -> Comparison:
        """The comparison's record, from which the report is written."""
        return read_comparison(self.folder)

    @cached_property
    def _summary(self) -> Summary:
        return summarise(self.record)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the compared methods, as given."""
        return self.record.methods

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Failed fits, with their errors."""
        return self.record.failures

    def run(self, method: str | Method, seed: int = 0) -> FolderRun:
        """Open the run of a method, given by its name or as it was given to `compare`.

        Raises:
            InputError: there is no such run, or it failed.
        """
        return load_run(self._run_folder(method, seed))

    def scores(self, method: str | Method, seed: int = 0) -> ScoreTable:
        """Scores of a method, given as to `run`.

        Raises:
            InputError: there is no such run, or it failed.
        """
        return ScoreTable(RunFolder(self._run_folder(method, seed)).read_scores())

    def _run_folder(self, method: str | Method, seed: int) -> Path:
        name = method.name if isinstance(method, Method) else method
        for run in self.record.runs:
            if (run.method, run.seed) == (name, seed):
                return run.folder
        for failure in self.failures:
            if (failure.method, failure.seed) == (name, seed):
                raise InputError(f"The fit of '{name}' with seed {seed} failed: {failure.error}")
        known = [f"{run.method} with seed {run.seed}" for run in self.record.runs]
        raise InputError(f"{self.folder} has no run of '{name}' with seed {seed}.", f"Its runs: {', '.join(known) or 'none'}.")

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Summary table of the report: headings, and a row of texts for each method and baseline; * marks significant leads."""
        summary = self._summary
        rows = [[row.label, *(f"{cell.text}{' *' if cell.best else ''}" for cell in row.cells)] for row in summary.rows]
        return ["", *(column.heading for column in summary.columns)], rows

    def __repr__(self) -> str:
        failed = f", {len(self.failures)} fits failed" if self.failures else ""
        return f"{self.record.question} {len(self.record.runs)} runs{failed}: {self.page}"

    def _repr_html_(self) -> str:
        return table_html(f"{self.record.question} {self._summary.legend}".strip(), *self.table())


def compare(
    scene: Scene | str,
    methods: Sequence[MethodLike] | MethodLike = (),
    budget: str = "60s",
    *,
    seeds: Sequence[int] | int = (0,),
    out: str | os.PathLike[str] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    render_with: Sequence[str] | str = (),
    data: Mapping[str, Any] | None = None,
    **more: Unpack[ReuseOptions],
) -> ComparisonResult:
    """Fit several methods to one scene under one budget, each in its own process, and write a report.

    The same call again keeps what is finished and goes on with what is not. A scene that was made in Python is kept as
    ``OUT/scene.npz`` for the processes that fit.

    Args:
        scene: loaded, made in Python, or what `load_scene` opens.
        methods: names, paths of recipes, tables, or loaded methods, or one of them; ``all``, or a pattern such as
            ``volumetric/*``, takes those that go with the scene; none leaves the choice to the scene.
        budget: of each fit, ``60s`` or ``5000steps``.
        seeds: each method is fitted once per seed.
        out: folder of the report and its runs; ``None`` for ``reports/compare-SCENE``.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        render_with: renderers that show the fitted fields besides their own.
        data: what is done to the training data: the keys that the command line takes as ``--set data.KEY=value``, such as
            ``{"train_views": 4, "init": "sfm"}`` (`invgraphics.scenes.degrade.TrainingData` explains them). On a rendered
            scene, methods that start from points are given those found in the training photographs (``sfm``) instead of
            the exact ones, unless ``data["init"]`` says otherwise; the ``--set`` of a printed hint is ``data`` here.
        **more: ``keep=True``: finished fits stay although code or packages have changed since.

    Raises:
        InputError: something cannot be used; found before the first fit.
        KeyboardInterrupt: interrupted; what is finished is kept.

    Example:
        >>> import invgraphics as ig
        >>> small = ig.load_method("volumetric/hash", set={"field.width": 16, "batches.rays": 64})
        >>> report = ig.compare("toy.npz", ["splatting/gaussians", small], budget="5steps", out="report")
        >>> report.methods, report.failures, report.page.name
        (('splatting/gaussians', 'volumetric/hash:field.width=16:batches.rays=64'), (), 'index.html')
    """
    scene = as_scene(scene)
    folder = Path("reports") / f"compare-{scene.name}" if out is None else Path(out)
    names, optional = _names(methods, folder)
    _, place = reopenable_scene(scene, folder)
    shown = tuple(listed(render_with, str))
    settings: dict[str, Any] = {"budget": budget, "device": device, "render_with": shown, "overrides": data_overrides(data)}
    settings |= {"seeds": whole_seeds(seeds), "out": str(folder), **place, **more}
    root, _ = comparing.compare(CompareRequest(methods=names, optional=optional, **settings))
    return ComparisonResult(root)


def _names(methods: Sequence[MethodLike] | MethodLike, folder: Path) -> tuple[tuple[str, ...], frozenset[str]]:
    """Names of methods for other processes, in order, patterns replaced by what only they name, and which those are."""
    given = listed(methods, (str, os.PathLike, Mapping, Method))
    _, optional = expand([method for method in given if isinstance(method, str)])
    names: list[str] = []
    for method in given:
        matching, by_pattern = expand([method]) if isinstance(method, str) else ((), ())
        if by_pattern:
            names += [name for name in matching if name in optional and name not in names]
        else:
            names.append(name_of(method, folder / "methods"))
    return tuple(names), optional
