"""Line plots of a study's analyses (`invgraphics.studies.analyses`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.report.figures.style import Figure, canvas, save, series_style
from invgraphics.runs.analysis import Analysis, analysis_path
from invgraphics.text import file_name

SIZE = (460.0, 380.0)
MARKED = 40
"""Curves with more points have no marker at each."""


@dataclass(frozen=True)
class AnalysisPart:
    """An analysis on a page: title, concluding sentence and line plot."""

    title: str
    sentence: str
    figure: Figure


def draw_analyses(root: Path, names: Sequence[str], figures: Path) -> list[AnalysisPart]:
    """Draw line plots of those analyses that are stored below the study's ``root``.

    Raises:
        InputError: a file is broken; the sentence names it.
    """
    parts = []
    for name in names:
        source = analysis_path(root, name)
        if source.is_file():
            parts.append(_draw(Analysis.read(source), figures / f"analysis-{file_name(name)}"))
    return parts


def _draw(analysis: Analysis, stem: Path) -> AnalysisPart:
    title, sentence = analysis.title, analysis.sentence
    with canvas(*SIZE) as (figure, axes):
        for index, curve in enumerate(analysis.curves):
            look = series_style(index)
            marker: dict[str, Any] = {"marker": look.marker, "markersize": 5} if len(curve.x) <= MARKED else {}
            axes.plot(
                curve.x,
                curve.y,
                color=look.colour,
                zorder=4 - 0.1 * index,
                linewidth=1.8,
                label=curve.label,
                **marker,
            )
        if analysis.logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")  # as text: labels are not typeset
        axes.set_xlabel(analysis.x)
        axes.set_ylabel(analysis.y)
        figure.legend(loc="outside upper left", ncols=1, frameon=False, fontsize=11)
        path = save(figure, stem)
    return AnalysisPart(title, sentence, Figure(path, None, title, f"{title}. {sentence}"))
