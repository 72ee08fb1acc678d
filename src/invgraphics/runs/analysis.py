"""``analyses/NAME.json``: an analysis beside a study's fits, as curves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from invgraphics.runs.inside import inside
from invgraphics.runs.schema import Record

FOLDER = "analyses"
"""Of all analyses, in the study's folder."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot: ``y`` over ``x``."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class Analysis(Record):
    """Result of an analysis: title, sentence, and curves.

    Attributes:
        title: a few words.
        sentence: what a reader should take away; the numbers in it are computed.
        x: name and unit of the horizontal axis.
        y: of the vertical axis.
        curves: all of them.
        logarithmic: whether the vertical axis is.
        name: of the analysis, as the study names it; written with the file.
        code: version and hash of the sources that computed it; written with the file.
    """

    title: str
    sentence: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False
    name: str = ""
    code: str = ""


def analysis_path(study: Path, name: str) -> Path:
    """The file of an analysis.

    Raises:
        InputError: the name or a link leads outside the study.
    """
    return inside(study, FOLDER, f"{name}.json")
