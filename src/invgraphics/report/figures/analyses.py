"""Curves of a study's analyses (`invgraphics.studies.analyses`), drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.report.data.reading import need, optional, read_table
from invgraphics.report.figures.style import Figure, canvas, save, series_style

SIZE = (460.0, 380.0)
MARKED = 40
"""Curves with more points have no marker at each."""


@dataclass(frozen=True)
class AnalysisPart:
    """An analysis on a page: what it says, and its plot."""

    title: str
    sentence: str
    figure: Figure


def draw_analyses(root: Path, names: Sequence[str], figures: Path) -> list[AnalysisPart]:
    """Draw the analyses that a study below ``root`` has written so far.

    Raises:
        InputError: a file is broken; the sentence names it.
    """
    parts = []
    for name in names:
        source = root / "analyses" / f"{name}.json"
        if source.is_file():
            parts.append(_draw(read_table(source), source, figures / f"analysis-{source.stem}"))
    return parts


def _draw(table: dict[str, Any], source: Path, stem: Path) -> AnalysisPart:
    title, sentence = need(table, "title", str, source), need(table, "sentence", str, source)
    with canvas(*SIZE) as (figure, axes):
        for index, curve in enumerate(need(table, "curves", list, source)):
            x, y = need(curve, "x", list, source), need(curve, "y", list, source)
            look = series_style(index)
            marker: dict[str, Any] = {"marker": look.marker, "markersize": 5} if len(x) <= MARKED else {}
            axes.plot(
                x,
                y,
                color=look.colour,
                zorder=4 - 0.1 * index,
                linewidth=1.8,
                label=need(curve, "label", str, source),
                **marker,
            )
        if optional(table, "logarithmic", bool, source, False):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")  # as text: labels are not typeset
        axes.set_xlabel(need(table, "x", str, source))
        axes.set_ylabel(need(table, "y", str, source))
        figure.legend(loc="outside upper left", ncols=1, frameon=False, fontsize=11)
        path = save(figure, stem)
    return AnalysisPart(title, sentence, Figure(path, None, title, f"{title}. {sentence}"))
