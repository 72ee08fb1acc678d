"""Plot style: one colour and one marker per method, SVG for light pages, dark pages and print."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invgraphics.files import write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True)
class Tone:
    """A colour on a light and on a dark page, both with at least 3:1 contrast to it."""

    light: str
    dark: str


SERIES = (
    Tone("#0072b2", "#56b4e9"),
    Tone("#d55e00", "#ff9a4d"),
    Tone("#00856a", "#34cfa3"),
    Tone("#a3387f", "#ee9ccb"),
    Tone("#8a6d00", "#f0d44c"),
    Tone("#5a5ad1", "#a9a8ff"),
    Tone("#007d8a", "#5fdbe8"),
    Tone("#7a4a2b", "#d6a37c"),
)
"""One per method, in order: Okabe and Ito's colour-blind-safe hues, darkened or lightened to read on either page."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)))
"""Methods beyond the eighth repeat a colour with another line."""

INK = Tone("#23262b", "#e4e6ea")
MUTED = Tone("#6b7078", "#9aa0a9")
GRID = Tone("#e3e5e8", "#2e323a")
PAGE = Tone("#ffffff", "#17191d")
"""Outlines of points, so that overlapping ones stay apart."""

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
POINTS = 72.0
"""Plots are drawn at 72 units per inch, so that a size in units is a size in CSS pixels."""


PANEL = (460.0, 330.0)
"""Width and height of a small plot, CSS pixels."""


@dataclass(frozen=True)
class Figure:
    """A saved plot with title and alternative text.

    Attributes:
        path: its SVG.
        narrow: the same plot drawn for a phone; ``None`` where the plot is small anyway.
        title: heading.
        alt: alternative text, its content in words.
    """

    path: Path
    narrow: Path | None
    title: str
    alt: str


@dataclass(frozen=True)
class SeriesStyle:
    """Line colour, marker and dashes of one method."""

    colour: str
    marker: str
    dash: Any


def series_style(index: int) -> SeriesStyle:
    """Style of the method at ``index``; beyond the last colour, colours repeat with other markers and dashes."""
    turn, position = divmod(index, len(SERIES))
    return SeriesStyle(SERIES[position].light, MARKERS[(position + turn) % len(MARKERS)], DASHES[turn % len(DASHES)])


@contextmanager
def canvas(width: float, height: float) -> Iterator[tuple[Canvas, Axes]]:
    """An empty plot of ``width`` x ``height`` CSS pixels in the house style; drawn and saved inside the block."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    settings: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": "invgraphics",
        "text.parse_math": False,
        "font.size": 12,
        "font.family": "DejaVu Sans",
        "axes.edgecolor": MUTED.light,
        "axes.labelcolor": INK.light,
        "axes.titlesize": 13,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlecolor": INK.light,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.8,
        "axes.axisbelow": True,
        "axes.grid": True,
        "axes.unicode_minus": True,
        "grid.color": GRID.light,
        "grid.linewidth": 0.8,
        "text.color": INK.light,
        "xtick.color": MUTED.light,
        "ytick.color": MUTED.light,
        "xtick.minor.visible": False,
    }
    with mpl.rc_context(settings):
        figure = Canvas(figsize=(width / POINTS, height / POINTS), dpi=POINTS, layout="constrained")
        axes = figure.add_subplot()
        yield figure, axes


def save(figure: Canvas, stem: Path) -> Path:
    """Write ``stem.svg``, which follows the reader's light or dark setting, and return its path."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    svg = stem.with_suffix(".svg")
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None}, transparent=True)
    write_text(svg, adaptive(drawn.getvalue()))
    return svg


def adaptive(svg: str) -> str:
    """Add the dark colours to an SVG drawn in light ones, and use the page's fonts.

    The light colours stay in place as plain attributes, for programs that know no media queries.
    """
    rules = []
    for tone in {tone.light: tone for tone in (*SERIES, INK, MUTED, GRID, PAGE)}.values():
        for part in ("stroke", "fill"):
            rules.append(f'[style*="{part}: {tone.light}"]{{{part}:{tone.dark} !important}}')
    sheet = f"<style>@media screen and (prefers-color-scheme: dark){{{''.join(rules)}}}</style>"
    svg = re.sub(r"font-family: 'DejaVu Sans'[^;\"]*", f"font-family: {FONT}", svg)
    svg = re.sub(r"(font: [^'\"]*)'DejaVu Sans'[^;\"]*", rf"\1{FONT}", svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return svg.replace("</defs>", f"{sheet}</defs>", 1)


def spread_labels(positions: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Move label positions apart so that neighbours are at least ``gap`` from each other, inside [low, high] where they fit."""
    order = sorted(range(len(positions)), key=lambda i: positions[i])
    placed = [positions[i] for i in order]
    for _ in range(50):
        moved = False
        for i in range(len(placed) - 1):
            overlap = gap - (placed[i + 1] - placed[i])
            if overlap > 1e-9 * gap:
                placed[i] -= overlap / 2
                placed[i + 1] += overlap / 2
                moved = True
        if not moved:
            break
    if placed:
        shift = max(low - placed[0], 0.0) or min(high - placed[-1], 0.0)
        placed = [position + shift for position in placed]
    result = [0.0] * len(placed)
    for i, position in zip(order, placed, strict=True):
        result[i] = position
    return result
