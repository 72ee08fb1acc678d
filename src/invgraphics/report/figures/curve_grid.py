"""Small multiples of monitor curves: one panel per scene and size, PSNR against seconds of optimisation on a log axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from invgraphics.report.figures.style import PAGE, PANEL, Figure, canvas, save, series_style
from invgraphics.report.statistics.rules import JudgedCell
from invgraphics.text import file_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_curve_panels(panels: Mapping[str, Sequence[JudgedCell]], methods: Sequence[str], folder: Path) -> list[Figure]:
    """One plot per panel; a line for every cell whose fit was monitored, coloured by its method.

    Args:
        panels: title -> its cells.
        methods: in the order of their colours.
        folder: where to write.
    """
    figures = []
    for title, cells in panels.items():
        lines = [(one, points) for one in cells if len(points := _points(one)) > 1]
        if not lines:
            continue
        ends = "; ".join(f"{one.cell.method}, {one.cell.budget}: {points[-1][1]:.1f} dB" for one, points in lines)
        with canvas(*PANEL) as (figure, axes):
            for one, points in lines:
                _draw_line(axes, one, points, methods.index(one.cell.method))
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(lambda seconds, _: f"{seconds:g}")
            axes.set_xlabel("seconds of optimisation")
            axes.set_ylabel("PSNR on monitored views (dB)")
            axes.set_title(title)
            path = save(figure, folder / f"curves-{file_name(title)}")
        figures.append(Figure(path, None, title, f"{title}, monitored PSNR at the end of each fit: {ends}."))
    return figures


def _points(one: JudgedCell) -> list[tuple[float, float]]:
    """(seconds, PSNR in dB) of a run's monitor; the measurement before the first step has no place on a log axis."""
    history = () if one.cell.run is None else one.cell.run.history
    return [(entry.seconds, entry.psnr) for entry in history if entry.psnr is not None and entry.seconds > 0]


def _draw_line(axes: Axes, one: JudgedCell, points: Sequence[tuple[float, float]], series: int) -> None:
    """Draw a monitor curve; its end marker is filled where the cell is green, hollow where a rule is broken."""
    look = series_style(series)
    seconds, psnr = zip(*points, strict=True)
    axes.plot(seconds, psnr, color=look.colour, linestyle=look.dash, linewidth=1.8)
    inside = PAGE.light if one.red else look.colour
    axes.plot(
        seconds[-1], psnr[-1], look.marker, color=look.colour, markerfacecolor=inside, markersize=7, clip_on=False, zorder=4
    )
