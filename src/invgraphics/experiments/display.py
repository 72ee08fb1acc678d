"""Notebook display of fits and scores: a curve as SVG, a table as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence

WIDTH, HEIGHT = 420, 180
"""Of a curve's drawing, px."""
LEFT, RIGHT, TOP, BOTTOM = 44, 12, 22, 30
"""Margins around the axes, px."""


def curve_svg(points: Sequence[tuple[float, float]], title: str, axes: tuple[str, str]) -> str:
    """Draw a curve through points as SVG; values that are not finite are left out.

    Args:
        points: (x, y), x rising.
        title: above the curve.
        axes: what x and y are, with their units.
    """
    shown = [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y)]
    (x0, x1), (y0, y1) = (_range([point[axis] for point in shown]) for axis in (0, 1))
    across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    path = " ".join(f"{LEFT + across * (x - x0) / (x1 - x0):.1f},{TOP + down * (y1 - y) / (y1 - y0):.1f}" for x, y in shown)
    base, end = HEIGHT - BOTTOM, WIDTH - RIGHT
    labels = [
        (LEFT, 14, "start", title),
        (LEFT - 4, TOP + 8, "end", f"{y1:.4g}"),
        (LEFT - 4, base, "end", f"{y0:.4g}"),
        (LEFT, base + 14, "start", f"{x0:.4g}"),
        (end, base + 14, "end", f"{x1:.4g} {axes[0]}"),
        (end, 14, "end", axes[1]),
    ]
    texts = "".join(f'<text x="{x}" y="{y}" text-anchor="{side}">{html.escape(text)}</text>' for x, y, side, text in labels)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" font-family="sans-serif" '
        f'font-size="11" fill="#555"><path d="M{LEFT},{TOP}V{base}H{end}" fill="none" stroke="#aaa"/>'
        f'<polyline points="{path}" fill="none" stroke="#2a6fbb" stroke-width="2"/>{texts}</svg>'
    )


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values, default=0.0), max(values, default=1.0)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def table_html(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table under a title as HTML."""
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><caption>{html.escape(title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
