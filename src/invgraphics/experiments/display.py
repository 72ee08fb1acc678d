"""Display of fits and scores in notebooks: a curve as SVG, a table as HTML, and scores as a mapping that shows itself."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import final

from invgraphics.runs.scores import Scores

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


@final
@dataclass(frozen=True, eq=False)
class ScoreTable(Mapping[str, float]):
    """Scores of a model on a scene's test views: metric -> mean over the views.

    Attributes:
        record: everything, as a run folder holds it: ``quality``, ``cost``, ``views``, ``skipped``, ``protocol``.

    Example:
        >>> import invgraphics as ig
        >>> from invgraphics.testing import TwoBalls, toy_scene
        >>> scene = toy_scene(views=2, size=16)
        >>> renderer = ig.load_method("volumetric/nerf").recipe.renderer.build(scene)
        >>> scores = ig.evaluate(ig.Model(TwoBalls(), renderer, scene.bounds), scene)
        >>> scores["psnr"] > 25 and scores.unit("psnr") == "dB" and len(scores.per_view("psnr")) == len(scene.test)
        True
    """

    record: Scores

    def __getitem__(self, metric: str) -> float:
        mean = self.record.quality[metric].mean
        return math.nan if mean is None else mean

    def __iter__(self) -> Iterator[str]:
        return iter(self.record.quality)

    def __len__(self) -> int:
        return len(self.record.quality)

    def per_view(self, metric: str) -> tuple[float, ...]:
        """One value for each test view, in the scene's order; NaN where a view has none."""
        return tuple(math.nan if value is None else value for value in self.record.quality[metric].per_view)

    def unit(self, metric: str) -> str:
        """The metric's unit; empty where it has none."""
        return self.record.quality[metric].unit

    def _title(self) -> str:
        return f"{self.record.scene}, {len(self.record.views)} test views, protocol {self.record.protocol}"

    def __repr__(self) -> str:
        return "\n".join([self._title(), *(f"  {name:20} {value:10.4g} {self.unit(name)}" for name, value in self.items())])

    def _repr_html_(self) -> str:
        better = {True: "higher", False: "lower"}
        rows = [
            (name, f"{value:.4g}", self.unit(name), better[self.record.quality[name].higher_is_better])
            for name, value in self.items()
        ]
        return table_html(self._title(), ("metric", "mean", "unit", "better"), rows)
