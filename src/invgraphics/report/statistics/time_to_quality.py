"""Time to quality: seconds of optimisation until the monitored PSNR reaches a level, as exact as the monitor looked."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.comparison import Comparison
from invgraphics.runs.run import Run

FINE_GRID = 0.5
"""Spacing of the monitor's evaluations, in seconds, below which times to a quality are printed to a tenth."""


def span_to_reach(run: Run, level: float) -> tuple[float, float] | None:
    """(last evaluation before, first one at which) the monitored PSNR was at least ``level`` dB, seconds; ``None`` if never."""
    before = 0.0
    for entry in run.history:
        if entry.psnr is None:
            continue
        if entry.psnr >= level:
            return before, entry.seconds
        before = entry.seconds
    return None


@dataclass(frozen=True)
class TimeToQuality:
    """Time to quality: median seconds of each method to reach each PSNR level.

    Attributes:
        levels: PSNR thresholds in dB, rising.
        rows: (method, series, one text per level).
    """

    levels: tuple[int, ...]
    rows: tuple[tuple[str, int, tuple[str, ...]], ...]


def time_to_quality(comparison: Comparison, count: int = 4) -> TimeToQuality | None:
    """Median seconds over seeds to reach ``count`` round PSNR levels between the slowest start and the best end."""
    starts, peaks = [], []
    for method in comparison.methods:
        curves = [[entry.psnr for entry in run.history if entry.psnr is not None] for run in comparison.runs_of(method)]
        curves = [curve for curve in curves if curve]
        if curves:
            starts.append(statistics.median(curve[0] for curve in curves))
            peaks.append(statistics.median_low(max(curve) for curve in curves))
    if not starts:
        return None
    low, high = max(starts), max(peaks)
    first, last = math.ceil(low + 0.1), math.floor(high)
    if last < first:
        return None
    step = max(1, (last - first) // max(1, count - 1))
    levels = tuple(range(last, first - 1, -step))[:count][::-1]
    rows = []
    for series, method in enumerate(comparison.methods):
        runs = comparison.runs_of(method)
        if runs:
            lost = len(comparison.failures_of(method))
            rows.append((method, series, tuple(_reach_text(runs, level, lost) for level in levels)))
    return TimeToQuality(levels, tuple(rows))


def _reach_text(runs: Sequence[Run], level: float, lost: int) -> str:
    """Median time in words, as exact as the monitor looked: ``36–42 s`` where it looked every 6 s, ``4.2 s`` where often.

    A seed that never got there took for ever, and so did the ``lost`` ones whose fits failed: without them the median would be
    one over the seeds that went well.
    """
    never = (math.inf, math.inf)
    spans = [span_to_reach(run, level) or never for run in runs] + [never] * lost
    first, last = (statistics.median(ends) for ends in zip(*spans, strict=True))
    if math.isinf(last):
        return "not reached"
    if last - first < FINE_GRID:
        return f"{last:.1f} s"
    return f"{first:.0f}–{last:.0f} s" if round(first) != round(last) else f"{last:.0f} s"
