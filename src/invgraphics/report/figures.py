"""The plots: time to quality, quality against cost, spread over views."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from invgraphics.report.records import Comparison, Run
from invgraphics.report.style import GRID, INK, MUTED, PAGE, canvas, save, series_style, spread_labels
from invgraphics.report.summary import Row, Summary, pareto_front
from invgraphics.report.wording import Quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Figure:
    """A plot on disk.

    Attributes:
        path: its SVG.
        narrow: the same plot drawn for a phone; ``None`` where the plot is small anyway.
        title: what it shows.
        alt: what a reader who cannot see it should know.
    """

    path: Path
    narrow: Path | None
    title: str
    alt: str


PANEL = (460.0, 330.0)
WIDE = (940.0, 400.0)
NARROW = (400.0, 360.0)


def draw_curves(comparison: Comparison, summary: Summary, folder: Path) -> Figure | None:
    """PSNR against seconds of optimisation, one line per run, with the noise ceiling and the better baseline."""
    if not any(entry.psnr is not None for run in comparison.runs for entry in run.history):
        return None
    title = "PSNR against optimisation time"
    wide = _curves(comparison, summary, folder / "time-to-quality", WIDE)
    narrow = _curves(comparison, summary, folder / "time-to-quality-narrow", NARROW)
    ends = [f"{run.method} ends at {_last(run):.1f} dB" for run in comparison.runs if _last(run) is not None]
    return Figure(wide, narrow, title, f"{title}: {'; '.join(ends)}.")


def draw_tradeoffs(summary: Summary, folder: Path) -> list[Figure]:
    """The first quality metric against each cost that at least one method has."""
    quality = next((column for column in summary.columns if column.group == "quality"), None)
    wanted = ("model_bytes", "render_fps", "peak_memory_bytes", "fit_seconds")
    figures = []
    for key in wanted:
        index = summary.column(key)
        if quality is None or index is None:
            continue
        # How long a fit may take is a cost here even where the budget fixes it.
        cost = summary.columns[index]
        better = "higher" if key == "render_fps" else "lower"
        cost = Quantity(cost.key, cost.label, cost.unit, better, "cost", cost.scale, cost.decimals)
        figure = _tradeoff(summary, quality, cost, folder / f"{quality.key}-against-{key.replace('_', '-')}")
        if figure is not None:
            figures.append(figure)
    return figures


def draw_distributions(comparison: Comparison, summary: Summary, folder: Path) -> list[Figure]:
    """One strip plot per quality metric: a dot per test view, with median and quartiles."""
    figures = []
    for column in (column for column in summary.columns if column.group == "quality"):
        values = {row.series: per_view(comparison.runs_of(row.label), column.key) for row in summary.methods}
        if any(values.values()):
            figures.append(_distribution(summary, column, values, folder / f"views-{column.key.replace('_', '-')}"))
    return figures


def per_view(runs: Sequence[Run], key: str) -> list[float]:
    """A metric on each test view, averaged over ``runs``; views that no run scored are left out."""
    columns = [run.quality[key].per_view for run in runs if key in run.quality]
    means = []
    for values in zip(*columns, strict=True):
        finite = [value for value in values if value is not None and math.isfinite(value)]
        if finite:
            means.append(statistics.fmean(finite))
    return means


def _last(run: Run) -> float | None:
    values = [entry.psnr for entry in run.history if entry.psnr is not None]
    return values[-1] if values else None


def _curves(comparison: Comparison, summary: Summary, stem: Path, size: tuple[float, float]) -> Path:
    narrow = size[0] < 500
    with canvas(*size) as (figure, axes):
        ends: list[tuple[int, str, float, float]] = []
        values: list[float] = []
        for series, method in enumerate(comparison.methods):
            look = series_style(series)
            runs = comparison.runs_of(method)
            for run in runs:
                points = [(entry.seconds, entry.psnr) for entry in run.history if entry.psnr is not None]
                if not points:
                    continue
                times, psnrs = zip(*points, strict=True)
                axes.plot(times, psnrs, color=look.colour, linestyle=look.dash, linewidth=2.2 if len(runs) == 1 else 1.5)
                axes.plot(times[-1], psnrs[-1], look.marker, color=look.colour, markersize=6.5, clip_on=False, zorder=4)
                values.extend(psnrs)
                if run is runs[-1]:
                    ends.append((series, method, times[-1], psnrs[-1]))
        axes.set_xlim(left=0)
        axes.set_xlabel("seconds of optimisation")
        axes.set_ylabel("PSNR on monitored views (dB)")
        _reference_lines(axes, comparison, summary, values)
        _end_labels(axes, ends, narrow)
        return save(figure, stem)


def _reference_lines(axes: Axes, comparison: Comparison, summary: Summary, values: Sequence[float]) -> None:
    """The noise ceiling and the better baseline; one that is far away is announced at the edge instead of squeezing the rest."""
    low, high = min(values), max(values)
    span = max(high - low, 1.0)
    bottom, top = low - 0.06 * span, high + 0.08 * span
    lines = []
    if comparison.noise_ceiling is not None:
        lines.append(("truth's noise ceiling", comparison.noise_ceiling))
    references = [
        (cell.mean, row.label) for row in summary.baselines if (cell := summary.cell(row, "psnr")) and cell.mean is not None
    ]
    if references:
        value, name = max(references)
        lines.append((f"baseline: {name}", value))
    for label, value in lines:
        if bottom - 0.5 * span <= value <= top + 0.35 * span:
            bottom, top = min(bottom, value - 0.08 * span), max(top, value + 0.1 * span)
            axes.axhline(value, color=MUTED.light, linewidth=1.2, linestyle=(0, (4, 3)), zorder=1)
            place, height, text = "bottom", value, f"{label}, {value:.1f} dB"
            axes.annotate(text, (0.012, height), (0, 3), xycoords=axes.get_yaxis_transform(), textcoords="offset points",
                          va=place, fontsize=11, color=MUTED.light)  # fmt: skip
        else:
            above = value > top
            axes.annotate(f"{label}, {value:.1f} dB {'↑' if above else '↓'}", (0.012, 1.0 if above else 0.0), (0, -2 if above else 3),
                          xycoords="axes fraction", textcoords="offset points", va="top" if above else "bottom",
                          fontsize=11, color=MUTED.light)  # fmt: skip
    axes.set_ylim(bottom, top)


def _end_labels(axes: Axes, ends: Sequence[tuple[int, str, float, float]], narrow: bool) -> None:
    """Name each line at its end, labels pushed apart; a narrow plot has a legend above instead."""
    if narrow:
        from matplotlib.lines import Line2D

        looks = [(series_style(series), method) for series, method, _, _ in ends]
        handles = [
            Line2D([], [], color=look.colour, linestyle=look.dash, marker=look.marker, label=name) for look, name in looks
        ]
        axes.figure.legend(
            handles=handles, loc="outside upper left", ncols=1 if len(ends) > 2 else 2, frameon=False, fontsize=11
        )
        return
    bottom, top = axes.get_ylim()
    places = spread_labels([psnr for *_, psnr in ends], 17 / 330 * (top - bottom), bottom, top)
    for (series, method, _, psnr), place in zip(ends, places, strict=True):
        axes.annotate(f"{method}  {psnr:.1f}", (1.0, place), (12, 0), xycoords=axes.get_yaxis_transform(), va="center",
                      textcoords="offset points", color=series_style(series).colour, fontweight="bold", annotation_clip=False)  # fmt: skip


def _tradeoff(summary: Summary, quality: Quantity, cost: Quantity, stem: Path) -> Figure | None:
    points: list[tuple[Row, float, float, float]] = []
    for row in summary.methods:
        x, y = summary.cell(row, cost.key), summary.cell(row, quality.key)
        if x and y and x.mean is not None and y.mean is not None and math.isfinite(y.mean) and x.mean > 0:
            points.append((row, x.mean * cost.scale, y.mean * quality.scale, (y.std or 0.0) * quality.scale))
    if not points:
        return None
    front = pareto_front([(cost.sort_key(x), quality.sort_key(y)) for _, x, y, _ in points])
    title = f"{quality.label} against {'rendering speed' if cost.key == 'render_fps' else _subject(cost)}"
    with canvas(*PANEL) as (figure, axes):
        _cost_axis(axes, [x for _, x, _, _ in points])
        axes.margins(y=0.18)
        for row, x, y, spread in points:
            look = series_style(row.series)
            axes.errorbar(x, y, yerr=spread or None, fmt=look.marker, color=look.colour, markersize=10, capsize=3,
                          markeredgecolor=PAGE.light, markeredgewidth=1, zorder=3)  # fmt: skip
        _staircase(axes, [points[i][1:3] for i in front], cost, quality)
        _point_labels(axes, points)
        axes.set_title(title, pad=22)
        axes.text(0, 1.025, f"better: {'up' if quality.better == 'higher' else 'down'} and to the "
                  f"{'right' if cost.better == 'higher' else 'left'}; dashed: Pareto front", transform=axes.transAxes,
                  fontsize=10.5, color=MUTED.light)  # fmt: skip
        axes.set_xlabel(f"{_subject(cost)} ({cost.unit})")
        axes.set_ylabel(f"{quality.label} ({quality.unit})" if quality.unit else quality.label)
        path = save(figure, stem)
    best = ", ".join(points[i][0].label for i in front)
    return Figure(path, None, title, f"{title}. On the Pareto front: {best}.")


def _subject(cost: Quantity) -> str:
    names = {
        "model_bytes": "model size",
        "render_fps": "frames per second",
        "peak_memory_bytes": "peak memory",
        "fit_seconds": "fit time",
    }
    return names[cost.key]


def _cost_axis(axes: Axes, values: Sequence[float]) -> None:
    """Logarithmic where costs differ by more than a quarter, else linear about them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    low, high = min(values), max(values)
    if high / low <= 1.25:
        middle = (low + high) / 2
        axes.set_xlim(middle * 0.8, middle * 1.2)
        return
    axes.set_xscale("log")
    pad = (high / low) ** 0.22
    axes.set_xlim(low / pad, high * pad)
    decades = math.log10(high / low * pad * pad)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if decades > 3 else (1.0, 3.0) if decades > 1.4 else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())


def _staircase(axes: Axes, front: Sequence[tuple[float, float]], cost: Quantity, quality: Quantity) -> None:
    """The boundary of what the front dominates, carried to the edges of the plot."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    worst_x = right if cost.better == "lower" else left
    worst_y = bottom if quality.better == "higher" else top
    xs, ys = [front[0][0]], [worst_y]
    for (x, y), after in zip(front, [*front[1:], (worst_x, front[-1][1])], strict=True):
        xs += [x, after[0]]
        ys += [y, y]
    axes.plot(xs, ys, color=INK.light, linewidth=1.1, linestyle=(0, (4, 3)), zorder=2)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def _point_labels(axes: Axes, points: Sequence[tuple[Row, float, float, float]]) -> None:
    """Name each point on the side where there is room, apart from its neighbours."""
    bottom, top = axes.get_ylim()
    places = spread_labels([y for _, _, y, _ in points], 15 / 235 * (top - bottom), bottom, top)
    for (row, x, y, _), place in zip(points, places, strict=True):
        fraction = axes.transAxes.inverted().transform(axes.transData.transform((x, y)))[0]
        left = fraction > 0.5
        axes.annotate(row.label, (x, place), (-10 if left else 10, 0), textcoords="offset points", va="center",
                      ha="right" if left else "left", fontsize=11, color=series_style(row.series).colour, fontweight="bold")  # fmt: skip


def _distribution(summary: Summary, column: Quantity, values: dict[int, list[float]], stem: Path) -> Figure:
    shown = [row for row in summary.methods if values[row.series]]
    with canvas(PANEL[0], 96 + 44 * len(shown)) as (figure, axes):
        for line, row in enumerate(shown):
            look, scores = series_style(row.series), [value * column.scale for value in values[row.series]]
            axes.boxplot([scores], positions=[line], orientation="horizontal", widths=0.62, showfliers=False, showcaps=False,
                         patch_artist=True, manage_ticks=False, whis=(0, 100), boxprops={"facecolor": "none", "edgecolor": look.colour},
                         medianprops={"color": look.colour, "linewidth": 2.4}, whiskerprops={"color": look.colour})  # fmt: skip
            heights = [line + 0.3 * (((7 * i) % 11) / 10 - 0.5) for i in range(len(scores))]
            axes.plot(scores, heights, look.marker, color=look.colour, markersize=5, alpha=0.75,
                      markeredgecolor=PAGE.light, markeredgewidth=0.6, zorder=3)  # fmt: skip
        axes.set_yticks(range(len(shown)), [row.label for row in shown], color=INK.light)
        axes.set_ylim(len(shown) - 0.45, -0.55)
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_color(GRID.light)
        axes.set_title(
            f"{column.label}{f' ({column.unit})' if column.unit else ''} per view, {column.better} is better", fontsize=12
        )
        path = save(figure, stem)
    medians = "; ".join(f"{row.label} median {column.text(statistics.median(values[row.series]))}" for row in shown)
    return Figure(path, None, f"{column.label} per view", f"{column.label} on each test view: {medians}.")
