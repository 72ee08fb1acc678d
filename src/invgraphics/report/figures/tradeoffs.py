"""Scatter plots of quality against cost, with the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invgraphics.report.figures.style import INK, MUTED, PAGE, PANEL, Figure, canvas, save, series_style
from invgraphics.report.statistics.summary import Row, Summary, pareto_front
from invgraphics.report.wording import TIMES, MeasuredQuantity, listing
from invgraphics.text import name_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUBJECTS = {
    "model_bytes": "model size",
    "render_fps": "rendering speed",
    "peak_memory_bytes": "peak memory",
    "fit_seconds": "fit time",
}
"""The costs that are plotted, and what their axis is about."""


MOST_COST = 1e15
"""Costs from its inverse up to it, in units as stored, are drawn; others are no measurements, and no axis holds them."""
MOST_LABELS = 8
"""Of more points only those on the front are named."""


@dataclass(frozen=True)
class Point:
    """A method in a plot: cost and quality as written, and half of the quality's interval over seeds."""

    row: Row
    cost: float
    quality: float
    spread: float


def draw_tradeoffs(summary: Summary, folder: Path) -> list[Figure]:
    """Scatter plots of the first quality metric against each cost that at least one method has."""
    quality = next((column for column in summary.columns if column.group != "cost"), None)
    figures = []
    for key in SUBJECTS:
        index = summary.column(key)
        if quality is None or index is None:
            continue
        # A fit's time is a cost here even where the budget fixes it and the table marks no winner.
        cost = replace(summary.columns[index], better="higher" if key == "render_fps" else "lower")
        points = _points(summary, quality, cost)
        if points:
            figures.append(_draw(points, quality, cost, folder / f"{quality.key}-against-{key.replace('_', '-')}"))
    return figures


def _points(summary: Summary, quality: MeasuredQuantity, cost: MeasuredQuantity) -> list[Point]:
    points = []
    for row in summary.methods:
        x, y = summary.cell(row, cost.key), summary.cell(row, quality.key)
        if x is None or y is None or x.mean is None or y.mean is None or not math.isfinite(y.mean):
            continue
        if not 1 / MOST_COST < x.mean < MOST_COST:
            continue
        points.append(Point(row, x.mean * cost.scale, y.mean * quality.scale, y.half_width * quality.scale))
    return points


def _draw(points: Sequence[Point], quality: MeasuredQuantity, cost: MeasuredQuantity, stem: Path) -> Figure:
    front = _front(points, quality, cost)
    title = f"{quality.label} against {SUBJECTS[cost.key]}"
    with canvas(*PANEL) as (figure, axes):
        _cost_axis(axes, [point.cost for point in points])
        axes.set_ylim(*_quality_limits(points))
        for point in points:
            look = series_style(point.row.series)
            mark: dict[str, Any] = {"markeredgecolor": PAGE.light, "markeredgewidth": 1.0, "markersize": 11, "zorder": 4}
            axes.vlines(point.cost, point.quality - point.spread, point.quality + point.spread, color=look.colour, zorder=3)
            axes.plot(point.cost, point.quality, look.marker, color=look.colour, **mark)
        if front:
            _staircase(axes, front, cost, quality)
        towards = f"{'up' if quality.better == 'higher' else 'down'} and {'right' if cost.better == 'higher' else 'left'}"
        axes.set_title(title, pad=24)
        note = f"better: {towards}." + ("  Dashed: Pareto front" if front else "")
        axes.text(0, 1.03, note, transform=axes.transAxes, fontsize=11, color=MUTED.light)
        axes.set_xlabel(f"{SUBJECTS[cost.key]} ({cost.unit})")
        axes.set_ylabel(f"{quality.label} ({quality.unit})" if quality.unit else quality.label)
        figure.draw_without_rendering()  # settles the layout, in whose pixels labels are placed
        _labels(axes, front if front and len(points) > MOST_LABELS else points)
        path = save(figure, stem)
    best = f"On the Pareto front: {listing(point.row.label for point in front)}" if front else "These times are not ranked"
    return Figure(path, None, title, f"{title}. {best}.")


def _front(points: Sequence[Point], quality: MeasuredQuantity, cost: MeasuredQuantity) -> list[Point]:
    """Pareto front by cost, over methods that are ranked in both: no seed lost, no clock disturbed.

    Where none is ranked, the front is that of all: what they have lost says nothing of their sizes. Times that a clock
    measured are then no cost at all: of fewer than two ranked methods there is no front.
    """
    ranked = [point for point in points if point.row.ranked_in(cost) and point.row.ranked_in(quality)]
    if cost.key in TIMES and len(ranked) < 2:
        return []
    ranked = ranked or list(points)
    # Costs are compared as written, to three digits: a hundredth of a second more does not change the front.
    keys = [(cost.sort_key(float(f"{point.cost:.3g}")), quality.sort_key(point.quality)) for point in ranked]
    return [ranked[i] for i in pareto_front(keys)]


def _quality_limits(points: Sequence[Point]) -> tuple[float, float]:
    """Limits of the quality axis; error bars much longer than the points' range are cut."""
    values = [point.quality for point in points]
    low, high = min(values), max(values)
    room = max(0.3 * (high - low), min(max(point.spread for point in points), 0.6 * (high - low))) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def _cost_axis(axes: Axes, values: Sequence[float]) -> None:
    """Scale the cost axis: logarithmic where costs differ by more than a quarter, else linear."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    low, high = min(values), max(values)
    if high / low <= 1.25:
        middle = (low + high) / 2
        axes.set_xlim(middle * 0.75, middle * 1.25)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        return
    axes.set_xscale("log")
    pad = (high / low) ** 0.25
    axes.set_xlim(low / pad, high * pad)
    decades = math.log10(high / low * pad * pad)
    subdivisions = (1.0,) if decades > 3 else (1.0, 3.0) if decades > 1.4 else (1.0, 2.0, 5.0)
    axes.xaxis.set_major_locator(LogLocator(subs=subdivisions))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _staircase(axes: Axes, front: Sequence[Point], cost: MeasuredQuantity, quality: MeasuredQuantity) -> None:
    """Draw the boundary of the region that the Pareto front dominates, extended to the plot's edges."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    xs, ys = [front[0].cost], [bottom if quality.better == "higher" else top]
    ends = [point.cost for point in front[1:]] + [right if cost.better == "lower" else left]
    for point, end in zip(front, ends, strict=True):
        xs += [point.cost, end]
        ys += [point.quality, point.quality]
    axes.plot(xs, ys, color=INK.light, linewidth=1.1, linestyle=(0, (4, 3)), zorder=2)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


LABEL_HEIGHT, LETTER_WIDTH, MARKER, LETTERS = 15.0, 7.3, 15.0, 28
"""Estimated sizes in CSS pixels: of a bold label's line and letters, and of a marker with its outline; letters of a line."""

Box = tuple[float, float, float, float]
"""Left, bottom, right, top in CSS pixels."""


def _labels(axes: Axes, points: Sequence[Point]) -> None:
    """Label each point beside, above or below it, at the offset of least overlap with markers and labels."""
    frame = axes.transAxes.transform([(0, 0), (1, 1)]).ravel().tolist()
    places = [axes.transData.transform((point.cost, point.quality)) for point in points]
    taken = [_box(x, y, MARKER, MARKER) for x, y in places]
    for point, (x, y) in zip(points, places, strict=True):
        lines = name_lines(point.row.label, LETTERS)
        width, height = LETTER_WIDTH * max(map(len, lines)), LABEL_HEIGHT * len(lines)
        beyond = MARKER / 2 + 3 + height / 2
        shift = MARKER / 2 + 3 + width / 2
        offsets = [(side * shift, rise) for rise in (0, 13, -13) for side in (1, -1)] + [(0.0, beyond), (0.0, -beyond)]
        boxes = [_box(x + right, y + up, width, height) for right, up in offsets]
        best = min(range(len(boxes)), key=lambda i: _clutter(boxes[i], taken, frame))
        taken.append(boxes[best])
        style: dict[str, Any] = {
            "ha": "center",
            "va": "center",
            "color": series_style(point.row.series).colour,
            "fontweight": "bold",
            "bbox": {"facecolor": PAGE.light, "edgecolor": "none", "pad": 1.0},
        }
        axes.annotate("\n".join(lines), (point.cost, point.quality), offsets[best], textcoords="offset points", **style)


def _box(x: float, y: float, width: float, height: float) -> Box:
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _clutter(box: Box, taken: Sequence[Box], frame: Sequence[float]) -> float:
    """Overlap of ``box`` with ``taken`` boxes plus twice its area outside ``frame``, px²."""
    area = (box[2] - box[0]) * (box[3] - box[1])
    return sum(_overlap(box, other) for other in taken) + 2 * (area - _overlap(box, frame))


def _overlap(a: Sequence[float], b: Sequence[float]) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
