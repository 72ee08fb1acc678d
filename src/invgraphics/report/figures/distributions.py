"""Strip plots of scores over test views."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.figures.style import GRID, INK, PAGE, PANEL, Figure, canvas, save, series_style
from invgraphics.report.statistics.summary import Summary
from invgraphics.report.statistics.values import clipped
from invgraphics.report.wording import MeasuredQuantity
from invgraphics.runs.run import Run
from invgraphics.text import file_name, name_lines

LETTERS = 28
"""Of a line of a method's name beside its scores."""


def draw_distributions(comparison: Comparison, summary: Summary, folder: Path) -> list[tuple[MeasuredQuantity, Figure]]:
    """One strip plot per quality metric: a dot per test view, with median and quartiles."""
    figures = []
    for column in (column for column in summary.columns if column.group != "cost"):
        values = {row.series: per_view(comparison.runs_of(row.label), column) for row in summary.methods}
        if any(values.values()):
            stem = folder / f"views-{file_name(column.key)}"
            figures.append((column, _draw(summary, column, values, stem)))
    return figures


def per_view(runs: Sequence[Run], column: MeasuredQuantity) -> list[float]:
    """A metric on each test view, averaged over ``runs``, perfect ones at a finite value; those without are left out."""
    scores = [run.scores.quality[column.key] for run in runs if column.key in run.scores.quality]
    means = []
    for values in zip(*(score.per_view for score in scores if score.per_view), strict=True):
        finite = [value for value in (clipped(value, column) for value in values) if math.isfinite(value)]
        if finite:
            means.append(statistics.fmean(finite))
    return means


def _draw(summary: Summary, column: MeasuredQuantity, values: dict[int, list[float]], stem: Path) -> Figure:
    shown = [row for row in summary.methods if values[row.series]]
    with canvas(PANEL[0], 92 + 46 * len(shown)) as (figure, axes):
        for line, row in enumerate(shown):
            look, scores = series_style(row.series), [value * column.scale for value in values[row.series]]
            axes.boxplot(
                [scores],
                positions=[line],
                orientation="horizontal",
                widths=0.6,
                whis=(0, 100),
                showcaps=False,
                manage_ticks=False,
                boxprops={"color": look.colour},
                medianprops={"color": look.colour, "linewidth": 2.6},
                whiskerprops={"color": look.colour},
            )
            # A fixed scatter about the line keeps equal scores apart; 7 and 11 share no factor.
            heights = [line + 0.3 * (((7 * i) % 11) / 10 - 0.5) for i in range(len(scores))]
            dots: dict[str, Any] = {
                "markersize": 5.5,
                "alpha": 0.75,
                "markeredgecolor": PAGE.light,
                "markeredgewidth": 0.6,
                "zorder": 3,
            }
            axes.plot(scores, heights, look.marker, color=look.colour, **dots)
        axes.set_yticks(range(len(shown)), ["\n".join(name_lines(row.label, LETTERS)) for row in shown], color=INK.light)
        axes.set_ylim(len(shown) - 0.45, -0.55)
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_color(GRID.light)
        unit = f" ({column.unit})" if column.unit else ""
        axes.set_title(f"{column.label}{unit} per view, {column.better} is better", fontsize=12.5)
        path = save(figure, stem)
    medians = "; ".join(f"{row.label} median {column.text(statistics.median(values[row.series]))}" for row in shown)
    return Figure(path, None, f"{column.label} per view", f"{column.label} on each test view: {medians}.")
