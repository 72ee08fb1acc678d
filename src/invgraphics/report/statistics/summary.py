"""Summary table of a comparison: means over seeds, best values, Pareto front and time to quality."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.statistics.clocks import Speeds, cpu_starved_fits
from invgraphics.report.statistics.intervals import mean_half_width
from invgraphics.report.statistics.leaders import leaders
from invgraphics.report.statistics.values import value_of, without_score
from invgraphics.report.wording import ABSENT, COSTS, TIMES, MeasuredQuantity, metric_label, quality_quantity
from invgraphics.runs.comparison import Failure
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score


@dataclass(frozen=True)
class Cell:
    """One cell of the summary: mean, deviation and interval over seeds, as numbers and text.

    Attributes:
        mean: over seeds, in stored units; ``None`` where there is none.
        std: sample standard deviation over seeds; ``None`` for a single one.
        half_width: half of the mean's t-interval over seeds; 0 for a single one.
        text: the mean as written.
        spread: the deviation as written; empty for a single seed.
        best: the method leads this column by more than chance (`invgraphics.report.statistics.leaders`).
        note: number of the footnote that explains an absence; 0 for none.
    """

    mean: float | None
    std: float | None
    text: str
    spread: str
    best: bool = False
    note: int = 0
    half_width: float = 0.0


@dataclass(frozen=True)
class Row:
    """Summary row of a method or of a trivial baseline.

    Attributes:
        label: its name.
        kind: what it is; ``failed`` is a method without a single run.
        series: index of its colour, the same in every plot; -1 for a baseline.
        seeds: number of runs that succeeded.
        failures: its failed cells.
        cells: one per column.
        complete: it has as many runs as the method with the most. Others are shown but never ranked: a hard seed that is
            missing makes a mean look better than it is.
        disturbed: why its times are not ranked: what is wrong with the clock of its fits; empty where nothing is.
        starved: whether one of its fits is among the `cpu_starved_fits`: its quality is not ranked either.
        lost: keys of the columns in which one of its fits diverged, or alone has no value; the others are not ranked either.
    """

    label: str
    kind: Literal["method", "baseline", "failed"]
    series: int
    seeds: int
    failures: tuple[Failure, ...]
    cells: tuple[Cell, ...]
    complete: bool = True
    disturbed: str = ""
    starved: bool = False
    lost: frozenset[str] = frozenset()

    def ranked_in(self, column: MeasuredQuantity) -> bool:
        """Whether it is ranked in a column: it lacks no seed and no seed's value, and no fit was disturbed in what counts."""
        disturbed = (self.disturbed and column.key in TIMES) or (self.starved and column.group != "cost")
        return self.complete and column.key not in self.lost and not disturbed


@dataclass(frozen=True)
class Summary:
    """Summary table of a comparison: methods and baselines against quantities.

    Attributes:
        columns: quality first, then cost.
        rows: methods in order, then baselines.
        notes: footnotes; note i is ``notes[i - 1]``.
        skipped: why -> labels of the metrics that no run has for that reason.
    """

    columns: tuple[MeasuredQuantity, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    skipped: dict[str, list[str]]

    def column(self, key: str) -> int | None:
        """Position of a quantity, ``None`` when the table has no such column."""
        return next((index for index, column in enumerate(self.columns) if column.key == key), None)

    def cell(self, row: Row, key: str) -> Cell | None:
        """The cell of ``row`` in the column ``key``."""
        index = self.column(key)
        return None if index is None else row.cells[index]

    @property
    def methods(self) -> tuple[Row, ...]:
        """Rows of methods that have at least one run."""
        return tuple(row for row in self.rows if row.kind == "method")

    @property
    def legend(self) -> str:
        """What * marks in a text table, or why it marks nothing, in parentheses; empty where nothing is compared."""
        if len(self.methods) < 2:
            return ""
        if any(cell.best for row in self.methods for cell in row.cells):
            return "(* leads all others by more than chance)"
        if all(row.seeds < 2 for row in self.methods):
            return "(one seed: no difference is told from chance)"
        return "(none leads all others by more than chance)"

    @property
    def disturbances(self) -> tuple[str, ...]:
        """A sentence for each method whose times, or quality too, are not ranked."""
        return tuple(
            f"The times {'and the quality ' if row.starved else ''}of {row.label} are not ranked: {row.disturbed}."
            for row in self.methods
            if row.disturbed
        )

    @property
    def baselines(self) -> tuple[Row, ...]:
        """Rows of trivial predictors."""
        return tuple(row for row in self.rows if row.kind == "baseline")


def summarise(comparison: Comparison, tables: int = 1) -> Summary:
    """Summarise a comparison: means over seeds; what leads a column by more than chance is marked.

    Args:
        comparison: the runs of one scene.
        tables: tables of the page, over which tests are corrected.
    """
    columns = table_columns(comparison)
    absences: dict[str, list[str]] = {}
    rows = []
    speeds, starved = Speeds.of(comparison.runs), set(map(id, cpu_starved_fits(comparison.runs)))
    most = max((len(comparison.runs_of(method)) for method in comparison.methods), default=0)
    for series, method in enumerate(comparison.methods):
        runs, failures = comparison.runs_of(method), comparison.failures_of(method)
        cells = tuple(_method_cell(column, runs, absences) for column in columns)
        kind: Literal["method", "failed"] = "method" if runs else "failed"
        lost = frozenset(column.key for column in columns if without_score(runs, column))
        clock = _disturbed(runs, speeds), any(id(run) in starved for run in runs)
        rows.append(Row(method, kind, series, len(runs), failures, cells, len(runs) == most, *clock, lost))
    for name, quality in comparison.baselines.items():
        cells = tuple(_cell(column, _known([_mean(quality.get(column.key))])) for column in columns)
        rows.append(Row(name, "baseline", -1, 1, (), cells))
    notes = tuple(f"{', '.join(labels)}: {reason}" for reason, labels in absences.items())
    return Summary(columns, _mark_best(comparison, columns, rows, tables), notes, _skipped(comparison))


def quality_columns(comparison: Comparison) -> tuple[MeasuredQuantity, ...]:
    """Quality metrics that at least one run or baseline has, the headline first, in the order of the one that has most."""
    found: dict[str, Score] = {}
    scored = [run.scores.quality for run in comparison.runs] + list(comparison.baselines.values())
    for quality in sorted(scored, key=len, reverse=True):
        for key, score in quality.items():
            found.setdefault(key, score)
    return tuple(quality_quantity(key, score) for key, score in found.items())


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point dominates, both coordinates smaller-is-better, by first coordinate.

    A point dominates another when it is nowhere worse and somewhere better; equal points stand together.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if not front or points[index][1] < points[front[-1]][1] or points[index] == points[front[-1]]:
            front.append(index)
    return front


def table_columns(comparison: Comparison) -> tuple[MeasuredQuantity, ...]:
    """Columns of the summary: quality metrics, then the costs that any run has."""
    budgets = {comparison.budget, *(run.provenance.budget for run in comparison.runs)}
    time_budget = any(budget and "step" not in budget for budget in budgets)
    costs = []
    for cost in COSTS:
        redundant = cost.key == "render_seconds_per_view"
        if redundant or all(run.scores.cost.get(cost.key) is None for run in comparison.runs):
            continue
        given = cost.key == "fit_seconds" and time_budget  # a fixed time budget ranks no method
        costs.append(replace(cost, better="none") if given else cost)
    return quality_columns(comparison) + tuple(costs)


def _mean(score: Score | None) -> float | None:
    return None if score is None else score.mean


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None and not math.isnan(value)]


def _method_cell(column: MeasuredQuantity, runs: Sequence[Run], absences: dict[str, list[str]]) -> Cell:
    """A method's cell in a column; why it lacks values is added to ``absences``, reason -> labels of the columns."""
    values = _known([value_of(run, column) for run in runs])
    reasons = [_absence(run, column) for run in runs if value_of(run, column) is None]
    reasons = list(dict.fromkeys(reason for reason in reasons if reason))
    if not reasons:
        return _cell(column, values)
    reason = "; ".join(reasons)
    if values:
        reason += f" ({len(runs) - len(values)} of {len(runs)} seeds)"
    labels = absences.setdefault(reason, [])
    if column.label not in labels:
        labels.append(column.label)
    return _cell(column, values, list(absences).index(reason) + 1)


def _absence(run: Run, column: MeasuredQuantity) -> str:
    if column.group == "cost":
        return ""  # not every method has every cost (primitives, for instance): no footnote
    if column.key in run.scores.quality:
        return "the score is not a number"
    return run.scores.skipped.get(column.key, "the run does not report it")


def _cell(column: MeasuredQuantity, values: Sequence[float], note: int = 0) -> Cell:
    if not values:
        return Cell(None, None, "n/a" if note else ABSENT, "", note=note)
    mean = statistics.fmean(values)
    std = statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else None
    half = 0.0 if std is None else mean_half_width(std, len(values))
    return Cell(mean, std, column.text(mean), "" if std is None else column.spread(mean, std), note=note, half_width=half)


def _mark_best(
    comparison: Comparison, columns: Sequence[MeasuredQuantity], rows: Sequence[Row], tables: int
) -> tuple[Row, ...]:
    """Mark the cell of each column's leader, where there is one."""
    means = []
    for index, column in enumerate(columns):
        ranked = [row for row in rows if row.kind == "method" and row.ranked_in(column)]
        means.append((column, {row.label: mean for row in ranked if (mean := row.cells[index].mean) is not None}))
    found = leaders(comparison, means, tables)
    marked = []
    for row in rows:
        leads = [column.key in found and found[column.key][0] == row.label and row.kind == "method" for column in columns]
        cells = (replace(cell, best=best) for cell, best in zip(row.cells, leads, strict=True))
        marked.append(replace(row, cells=tuple(cells)))
    return tuple(marked)


def _disturbed(runs: Sequence[Run], speeds: Speeds) -> str:
    """Seeds of a method whose timings were disturbed, with the cause; empty where none were."""
    seeds = {run.seed: why for run in runs if (why := speeds.disturbance(run))}
    return "; ".join(f"seed {seed} {how}" for seed, how in seeds.items())


def _skipped(comparison: Comparison) -> dict[str, list[str]]:
    reasons: dict[str, list[str]] = {}
    for run in comparison.runs:
        for key, why in run.scores.skipped.items():
            reasons.setdefault(key, []).append(why)
    present = {column.key for column in quality_columns(comparison)}
    labels: dict[str, list[str]] = {}
    for key, why in reasons.items():
        if key not in present:
            labels.setdefault("; ".join(dict.fromkeys(why)), []).append(metric_label(key))
    return labels
