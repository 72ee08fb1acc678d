"""Comparison of several methods on one scene, each fitted in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from invgraphics.api.loading import MethodLike, as_scene, load_run, name_of, reopenable_scene
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments import compare as comparing
from invgraphics.experiments.display import table_html
from invgraphics.experiments.request import CompareRequest
from invgraphics.experiments.session import FolderRun, ScoreTable
from invgraphics.recipes.recipe import expand
from invgraphics.report.build import build_report
from invgraphics.report.data.comparison import Comparison, read_comparison
from invgraphics.report.statistics.summary import summarise
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

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the compared methods, as given."""
        return self.record.methods

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Failed fits, with their errors."""
        return self.record.failures

    def run(self, method: str, seed: int = 0) -> FolderRun:
        """Open the run of a method.

        Raises:
            InputError: there is no such run, or it failed.
        """
        return load_run(self._run_folder(method, seed))

    def scores(self, method: str, seed: int = 0) -> ScoreTable:
        """Scores of a method.

        Raises:
            InputError: there is no such run, or it failed.
        """
        return ScoreTable(RunFolder(self._run_folder(method, seed)).read_scores())

    def _run_folder(self, method: str, seed: int) -> Path:
        for run in self.record.runs:
            if (run.method, run.seed) == (method, seed):
                return run.folder
        raise InputError(
            f"{self.folder} has no run of '{method}' with seed {seed}.", f"Its methods: {', '.join(self.methods)}."
        )

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Summary table of the report: headings, and a row of texts for each method and baseline; * marks the best."""
        summary = summarise(self.record)
        rows = [[row.label, *(f"{cell.text}{' *' if cell.best else ''}" for cell in row.cells)] for row in summary.rows]
        return ["", *(column.heading for column in summary.columns)], rows

    def __repr__(self) -> str:
        failed = f", {len(self.failures)} fits failed" if self.failures else ""
        return f"{self.record.question} {len(self.record.runs)} runs{failed}: {self.page}"

    def _repr_html_(self) -> str:
        return table_html(f"{self.record.question} (* best)", *self.table())


def compare(
    scene: Scene | str,
    methods: Sequence[MethodLike] | str = (),
    budget: str = "60s",
    *,
    seeds: Sequence[int] = (0,),
    out: str | os.PathLike[str] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    render_with: Sequence[str] = (),
) -> ComparisonResult:
    """Fit several methods to one scene under one budget, each in its own process, and write a report.

    The same call again keeps what is finished and goes on with what is not. A scene that was made in Python is kept as
    ``OUT/scene.npz`` for the processes that fit.

    Args:
        scene: loaded, made in Python, or what `load_scene` opens.
        methods: names, paths of recipes, tables, or loaded methods; ``all``, or a pattern such as ``volumetric/*``, takes
            those that go with the scene; none leaves the choice to the scene.
        budget: of each fit, ``60s`` or ``5000steps``.
        seeds: each method is fitted once per seed.
        out: folder of the report and its runs; ``None`` for ``reports/compare-SCENE``.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        render_with: renderers that show the fitted fields besides their own.

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
    given = [methods] if isinstance(methods, str) else list(methods)
    expanded, optional = expand([method for method in given if isinstance(method, str)])
    others = [method for method in given if not isinstance(method, str)]
    ordered = [*expanded, *others] if optional else given
    names = [name_of(method, folder / "methods") for method in ordered]
    _, place = reopenable_scene(scene, folder)
    settings: dict[str, Any] = {"budget": budget, "device": device, "render_with": tuple(render_with), **place}
    request = CompareRequest(methods=tuple(names), seeds=tuple(seeds), optional=optional, out=str(folder), **settings)
    root, _ = comparing.compare(request)
    return ComparisonResult(root)
