"""A run's value of a quantity: perfect pictures count, diverged fits are told from metrics that do not exist."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

from invgraphics.report.wording import MeasuredQuantity
from invgraphics.runs.run import Run

PERFECT_DB = 100.0
"""PSNR from which on a picture counts as perfect: errors of 1e-5 of white. Without a limit one equal picture is infinite."""


def value_of(run: Run, column: MeasuredQuantity) -> float | None:
    """A run's value of a quantity, in stored units; a PSNR of equal pictures counts as `PERFECT_DB`."""
    if column.group == "cost":
        return run.scores.cost.get(column.key)
    score = run.scores.quality.get(column.key)
    if score is None or score.mean is None:
        return None
    if math.isinf(score.mean) and column.unit == "dB" and score.per_view:
        return statistics.fmean(math.nan if value is None else clipped(value, column) for value in score.per_view)
    return clipped(score.mean, column)


def clipped(value: float | None, column: MeasuredQuantity) -> float:
    """A score with perfection at a finite value; NaN for ``None``."""
    if value is None:
        return math.nan
    return min(value, PERFECT_DB) if column.unit == "dB" and column.better == "higher" else value


def diverged(run: Run, column: MeasuredQuantity) -> bool:
    """Whether a fit has no finite score because it diverged, rather than because the metric is undefined or was not computed.

    Of a picture's metric, one view that is not finite is enough: the others would flatter the fit. Geometry is undefined in
    views where truth and prediction share no surface, so that there all views must lack it.
    """
    if column.group == "cost":
        value = run.scores.cost.get(column.key)
        return value is not None and not math.isfinite(value)
    score = run.scores.quality.get(column.key)
    if score is None:
        return "finite" in run.scores.skipped.get(column.key, "")
    values = [clipped(value, column) for value in score.per_view] or [clipped(score.mean, column)]
    broken = [not math.isfinite(value) for value in values]
    return any(broken) if column.group == "image" else all(broken)


def without_score(runs: Sequence[Run], column: MeasuredQuantity) -> list[Run]:
    """Runs of one method and scene that failed at a quantity: diverged, or without a quality metric that another of them has.

    A metric that all of them lack is undefined there. One that only some lack, as where no surface was found, went wrong in
    these, and a mean over the others would be the better for it.
    """
    valued = [value_of(run, column) is not None and not diverged(run, column) for run in runs]
    owed = column.group != "cost" and any(valued)
    return [run for run, has in zip(runs, valued, strict=True) if not has and (owed or diverged(run, column))]


def run_values(runs: Sequence[Run], quantity: MeasuredQuantity) -> list[float] | None:
    """Mean of each run over the views in which all of them have a finite score; over all where single views have none."""
    if quantity.group != "cost":
        tables = [_views(run, quantity) for run in runs]
        if all(tables):
            names = [name for name in tables[0] if all(name in table for table in tables)]
            return [sum(table[name] for name in names) / len(names) for table in tables] if names else None
    values = [value_of(run, quantity) for run in runs]
    known = [value for value in values if value is not None and math.isfinite(value)]
    return known if len(known) == len(values) else None


def _views(run: Run, quantity: MeasuredQuantity) -> dict[str, float]:
    """View -> finite score; empty where single views have none."""
    score = run.scores.quality.get(quantity.key)
    if score is None or not score.per_view:
        return {}
    values = (clipped(value, quantity) for value in score.per_view)
    pairs = zip(run.scores.views, values, strict=True)
    return {name: value for name, value in pairs if value is not None and math.isfinite(value)}
