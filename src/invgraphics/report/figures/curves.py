"""Time to quality: PSNR against seconds of optimisation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.figures.style import MUTED, Figure, SeriesStyle, canvas, save, series_style, spread_labels
from invgraphics.report.statistics.intervals import band
from invgraphics.report.statistics.summary import Summary
from invgraphics.runs.run import Run
from invgraphics.text import name_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE = (940.0, 400.0)
NARROW = (400.0, 380.0)
LINE, WIDE_LETTERS, NARROW_LETTERS = 18.0, 32, 42
"""CSS pixels of a label's line, and letters on it."""

MANY, STRONG, FAINT = 4, 0.16, 0.08
"""Bands of more than ``MANY`` methods are drawn fainter."""

End = tuple[int, str, float]
"""Where a line ends: series, method, PSNR in dB."""


def draw_curves(comparison: Comparison, summary: Summary, folder: Path) -> Figure | None:
    """PSNR over time, a line per method, with noise level and better baseline; ``None`` where no run was monitored.

    Of several seeds the line is the mean, and a band its t-interval over seeds; each seed's own end is marked.
    """
    methods = [method for _, method in comparison.drawn_methods]
    runs = [run for method in methods for run in comparison.runs_of(method) if _last(run) is not None]
    if not runs:
        return None
    title = "PSNR against optimisation time"
    wide = _draw(comparison, summary, folder / "time-to-quality", WIDE)
    narrow = _draw(comparison, summary, folder / "time-to-quality-narrow", NARROW)
    ends = [f"{run.method} ends at {last:.1f} dB" for run in runs if (last := _last(run)) is not None]
    return Figure(wide, narrow, title, f"{title}, on monitored pixels rather than the table's test views: {'; '.join(ends)}.")


def _last(run: Run) -> float | None:
    values = [entry.psnr for entry in run.history if entry.psnr is not None]
    return values[-1] if values else None


def _draw(comparison: Comparison, summary: Summary, stem: Path, size: tuple[float, float]) -> Path:
    narrow = size == NARROW
    height = size[1] + _more_height([method for _, method in comparison.drawn_methods], narrow)
    with canvas(size[0], height) as (figure, axes):
        ends: list[End] = []
        values: list[float] = []
        several = len(comparison.drawn_methods) > MANY
        for series, method in comparison.drawn_methods:
            curves = [curve for run in comparison.runs_of(method) if (curve := _curve(run)) is not None]
            if curves:
                _draw_seeds(axes, curves, series_style(series), FAINT if several else STRONG)
                values.extend(float(psnr) for _, psnrs in curves for psnr in psnrs if np.isfinite(psnr))
                ends.append((series, method, sum(float(psnrs[-1]) for _, psnrs in curves) / len(curves)))
        axes.set_xlim(left=0, right=axes.dataLim.x1 * 1.01)
        axes.set_xlabel("seconds of optimisation")
        axes.set_ylabel("PSNR on monitored views (dB)")
        _reference_lines(axes, comparison, summary, values)
        if narrow:
            _legend(axes, ends)
        else:
            _end_labels(axes, ends, height)
        return save(figure, stem)


def _more_height(methods: Sequence[str], narrow: bool) -> float:
    """Pixels by which a plot is higher than usual, for many or long names."""
    if narrow:
        return max(0.0, LINE * sum(len(name_lines(method, NARROW_LETTERS)) for method in methods) - 0.3 * NARROW[1])
    return max(0.0, LINE * max(len(name_lines(method, WIDE_LETTERS)) for method in methods) * len(methods) - 0.8 * WIDE[1])


Curve = tuple[Float[ndarray, " time"], Float[ndarray, " time"]]
"""Seconds of optimisation, and PSNR in dB then."""


def _curve(run: Run) -> Curve | None:
    points = [(entry.seconds, entry.psnr) for entry in run.history if entry.psnr is not None]
    return (np.array([time for time, _ in points]), np.array([psnr for _, psnr in points])) if points else None


def mean_curve(curves: Sequence[Curve]) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """(seconds, mean, low, high) over seeds, at every moment at which one was measured and all were running.

    Between its measurements a seed is read off by linear interpolation.
    """
    start, end = max(times[0] for times, _ in curves), min(times[-1] for times, _ in curves)
    moments = np.unique(np.concatenate([times for times, _ in curves]))
    moments = moments[(moments >= start) & (moments <= end)]
    if not len(moments):  # one seed ended before another began to be measured
        moments = np.array([end])
    return moments, *band(np.stack([np.interp(moments, *curve) for curve in curves]))


def _draw_seeds(axes: Axes, curves: Sequence[Curve], look: SeriesStyle, opacity: float) -> None:
    moments, mean, low, high = mean_curve(curves)
    axes.plot(moments, mean, color=look.colour, linestyle=look.dash, linewidth=2.4)
    if len(curves) > 1:
        axes.fill_between(moments, low, high, color=look.colour, alpha=opacity, linewidth=0)
    for times, psnrs in curves:
        axes.plot(times[-1], psnrs[-1], look.marker, color=look.colour, markersize=7, clip_on=False, zorder=4)


def _reference_lines(axes: Axes, comparison: Comparison, summary: Summary, values: Sequence[float]) -> None:
    """Draw lines at noise level and better baseline; far ones become a label at the edge, which keeps the curves' range."""
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    span = max(high - low, 1.0)
    bottom, top = low - 0.06 * span, high + 0.08 * span
    lines = []
    if comparison.noise_ceiling is not None:
        lines.append(("truth's noise level", comparison.noise_ceiling))
    cells = [(summary.cell(row, "psnr"), row.label) for row in summary.baselines]
    references = [(cell.mean, name) for cell, name in cells if cell is not None and cell.mean is not None]
    if references:
        value, name = max(references)
        lines.append((f"baseline: {name}", value))
    for label, value in lines:
        near = bottom - 0.5 * span <= value <= top + 0.35 * span
        text = f"{label}, {value:.1f} dB"
        if near:
            bottom, top = min(bottom, value - 0.08 * span), max(top, value + 0.1 * span)
            axes.axhline(value, color=MUTED.light, linewidth=1.2, linestyle=(0, (4, 3)), zorder=1)
            # At the right end: on the left the curves themselves rise through this height.
            place, offset, align = (0.988, value), (0, -4), "top"
            coordinates = axes.get_yaxis_transform()
        else:
            above = value > top
            text += " ↑" if above else " ↓"
            place, offset, align = (0.988, float(above)), (0, -2 if above else 3), "top" if above else "bottom"
            coordinates = axes.transAxes
        style: dict[str, Any] = {"fontsize": 11, "color": MUTED.light, "ha": "right", "va": align}
        axes.annotate(text, place, offset, xycoords=coordinates, textcoords="offset points", **style)
    axes.set_ylim(bottom, top)


def _legend(axes: Axes, ends: Sequence[End]) -> None:
    from matplotlib.lines import Line2D

    looks = [(series_style(series), _ended(method, psnr, NARROW_LETTERS)) for series, method, psnr in ends]
    handles = [Line2D([], [], color=look.colour, linestyle=look.dash, marker=look.marker, label=name) for look, name in looks]
    axes.figure.legend(handles=handles, loc="outside upper left", ncols=1, frameon=False, fontsize=12)


def _ended(method: str, psnr: float, letters: int) -> str:
    return "\n".join(name_lines(method, letters)) + f"  {psnr:.1f}"


def _end_labels(axes: Axes, ends: Sequence[End], height: float) -> None:
    """Label each line at its end, overlapping labels moved apart; ``height`` is the plot's in pixels."""
    bottom, top = axes.get_ylim()
    texts = [_ended(method, psnr, WIDE_LETTERS) for _, method, psnr in ends]
    gap = LINE * max(text.count("\n") + 1 for text in texts) / (height - 70) * (top - bottom)
    places = spread_labels([psnr for *_, psnr in ends], gap, bottom, top)
    for (series, _, _), text, place in zip(ends, texts, places, strict=True):
        style: dict[str, Any] = {
            "color": series_style(series).colour,
            "fontweight": "bold",
            "va": "center",
            "annotation_clip": False,
        }
        coordinates = axes.get_yaxis_transform()
        axes.annotate(text, (1.0, place), (12, 0), xycoords=coordinates, textcoords="offset points", **style)
