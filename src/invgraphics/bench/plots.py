"""Plots of a benchmark run, in a style injected by the caller."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.bench.growth import Growth, growths
from invgraphics.bench.results import BOTH, FORWARD_ONLY, MACHINE, THREADS, Results
from invgraphics.bench.tables import kernels_of, quantity, sizes
from invgraphics.kernels.dispatch import IMPLEMENTATIONS

PANEL = (440.0, 310.0)
"""Width and height of a small plot, CSS pixels."""
ROW = 26.0
"""Height of a bar."""


@dataclass(frozen=True)
class PlotStyle:
    """Style of plots and page. Injected by the caller, since this package may not import the report's.

    Attributes:
        canvas: an empty plot of a width and a height, as a context with figure and axes.
        save: writes a figure as SVG under a path without suffix; returns the path.
        series: colour, marker and dash of the n-th line.
        stylesheet: the page's CSS.
    """

    canvas: Callable[[float, float], AbstractContextManager[tuple[Any, Any]]]
    save: Callable[[Any, Path], Path]
    series: Callable[[int], Any]
    stylesheet: str


@dataclass(frozen=True)
class Plot:
    """A plot on disk and its alternative text."""

    path: Path
    alt: str


@dataclass(frozen=True)
class Line:
    """One curve: its name, the index of its style, and its points."""

    name: str
    series: int
    x: tuple[float, ...]
    y: tuple[float, ...]


def growth_plots(results: Results, folder: Path, style: PlotStyle) -> list[Plot]:
    """Log-log plots of time against every varied size, one per kernel and size."""
    groups: dict[tuple[str, str, str, str], list[Growth]] = {}
    for g in growths(kernels_of(results)):
        if g.direction == BOTH or g.operation in FORWARD_ONLY:
            groups.setdefault((g.operation, g.along, str(g.fixed), g.direction), []).append(g)
    plots = []
    for number, ((operation, along, _, direction), members) in enumerate(groups.items()):
        lines = [
            Line(
                f"{g.implementation}, exponent {g.exponent:.2f}",
                IMPLEMENTATIONS.index(g.implementation),
                g.values,
                g.milliseconds,
            )
            for g in members
        ]
        title = f"{operation}, {direction}" + (f"; {sizes(members[0].fixed)}" if members[0].fixed else "")
        stem = folder / f"growth-{number:02d}-{operation}-{along.replace(' ', '-')}"
        plots.append(_log_log(lines, title, (along, "ms"), stem, style))
    return plots


def share_plot(results: Results, folder: Path, style: PlotStyle) -> Plot | None:
    """Bar chart of each kernel's fraction of its hardware limit, at the largest measured size."""
    largest = {(m.operation, m.direction): m for m in kernels_of(results) if m.share and m.implementation == "numba"}
    if not largest:
        return None
    names = [f"{operation}, {direction}" for operation, direction in largest]
    shares = [100 * (m.share or 0) for m in largest.values()]
    with style.canvas(2 * PANEL[0], 90 + ROW * len(names)) as (figure, axes):
        axes.barh(names[::-1], shares[::-1], color=style.series(1).colour, height=0.6)
        for place, (share, m) in enumerate(zip(shares[::-1], [*largest.values()][::-1], strict=True)):
            axes.annotate(
                f"{share:.2g} % of {m.limit}", (share, place), (5, 0), textcoords="offset points", va="center", fontsize=11
            )
        axes.set_xlim(0, max(100.0, 1.3 * max(shares)))
        axes.set_xlabel("% of the limit, measured in alternation")
        axes.grid(visible=False, axis="y")
        axes.set_title("Share of the machine's limit, at each kernel's last size")
        path = style.save(figure, folder / "shares")
    summary = "; ".join(f"{name} {share:.2g} %" for name, share in zip(names, shares, strict=True))
    return Plot(path, f"Share of the machine's limit: {summary}.")


def gather_plot(results: Results, folder: Path, style: PlotStyle) -> Plot | None:
    """Plot random look-ups per second against the table's bytes."""
    found = [m for m in results.measurements if m.implementation == MACHINE and m.operation.startswith("gather")]
    if len(found) < 2:
        return None
    line = Line("", 0, tuple(m.sizes["bytes"] / 2**20 for m in found), tuple(m.rate / 1e6 for m in found))
    labels = ("table, MB", "million look-ups/s")
    return _log_log([line], "Random look-ups of 8 bytes", labels, folder / "gather", style)


def thread_plot(results: Results, folder: Path, style: PlotStyle) -> Plot | None:
    """Speed-up against threads."""
    found = [m for m in results.measurements if m.operation.startswith(THREADS)]
    lines = []
    for operation in dict.fromkeys(m.operation for m in found):
        by = sorted((m.threads, m.timing.median) for m in found if m.operation == operation)
        counts, times = zip(*by, strict=True)
        lines.append(Line(operation.rpartition(": ")[2], len(lines), counts, tuple(times[0] / t for t in times)))
    if not lines:
        return None
    return _log_log(lines, "Speed-up with threads", ("threads", "times faster than one"), folder / "threads", style)


def _log_log(lines: list[Line], title: str, labels: tuple[str, str], stem: Path, style: PlotStyle) -> Plot:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    with style.canvas(*PANEL) as (figure, axes):
        for line in lines:
            series = style.series(line.series)
            axes.plot(line.x, line.y, color=series.colour, marker=series.marker, linestyle=series.dash, label=line.name)
        axes.set(xscale="log", yscale="log", xlabel=labels[0], ylabel=labels[1])
        ticks = sorted({x for line in lines for x in line.x})
        axes.set_xticks(ticks, [quantity(x) for x in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        if len(lines) > 1 or lines[0].name:
            axes.legend(frameon=False, fontsize=11)
        axes.set_title(title, fontsize=11)
        path = style.save(figure, stem)
    summary = "; ".join(f"{line.name}: {', '.join(f'{y:.3g}' for y in line.y)}" for line in lines)
    return Plot(path, f"{title}. {labels[1]} against {labels[0]}. {summary}.")
