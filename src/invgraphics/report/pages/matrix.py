"""The table of methods, field by renderer, with what a comparison measured in each cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.figures.views import Picture
from invgraphics.report.pages.parts import Part
from invgraphics.report.statistics.summary import Row, Summary
from invgraphics.report.wording import MeasuredQuantity
from invgraphics.runs.comparison import Refusal

LEAST_METHODS = 5
"""Fewer methods than this are compared by the summary alone."""
FIGURES = ("normal_deg", "model_bytes", "fit_seconds", "render_fps")
"""Quantities of a cell below the first metric, where the comparison has them."""


@dataclass(frozen=True)
class Entry:
    """A method in its cell.

    Attributes:
        method: its name.
        series: index of its colour.
        picture: of the first test view that the page shows; ``None`` where it has none.
        score: the first metric, as written; empty where the method failed.
        figures: (label, value) of the other quantities.
        best_of_row: best first metric of at least two entries in its row, as measured.
        best_of_column: the same of its column.
        failed: why it gave no run; empty where it did.
    """

    method: str
    series: int
    picture: Picture | None
    score: str
    figures: tuple[tuple[str, str], ...]
    best_of_row: bool = False
    best_of_column: bool = False
    failed: str = ""


@dataclass(frozen=True)
class Matrix:
    """Fields as rows, renderers as columns, methods in the cells.

    Attributes:
        quantity: the metric that ranks.
        columns: titles of renderers.
        rows: (title of the field, the entries of each column).
        refused: methods that do not go with the scene, and why.
        several_seeds: whether scores are means over seeds.
    """

    quantity: MeasuredQuantity
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[tuple[Entry, ...], ...]], ...]
    refused: tuple[Refusal, ...]
    several_seeds: bool


def method_matrix(part: Part) -> Matrix | None:
    """Arrange a comparison's methods by field and renderer; ``None`` for few methods, or where their cells are not known."""
    comparison, summary = part.comparison, part.summary
    placed = [row for row in summary.rows if row.kind != "baseline" and row.label in comparison.cells]
    if len(placed) < LEAST_METHODS or not summary.columns or not summary.methods:
        return None
    cells = {row.label: comparison.cells[row.label] for row in placed}
    fields = tuple(dict.fromkeys(field for field, _ in cells.values()))
    renderers = tuple(dict.fromkeys(renderer for _, renderer in cells.values()))
    pictures = {method: picture for method, _, picture in part.drawn.views[0].layers[0].methods} if part.drawn.views else {}
    best_rows = _best(comparison, summary, placed, axis=0)
    best_columns = _best(comparison, summary, placed, axis=1)
    entries = {
        row.label: _entry(summary, row, pictures.get(row.label), row.label in best_rows, row.label in best_columns)
        for row in placed
    }
    rows = [
        (field, tuple(tuple(entries[name] for name in cells if cells[name] == (field, renderer)) for renderer in renderers))
        for field in fields
    ]
    return Matrix(summary.columns[0], renderers, tuple(rows), comparison.refused, part.several_seeds)


def _entry(summary: Summary, row: Row, picture: Picture | None, best_of_row: bool, best_of_column: bool) -> Entry:
    if row.kind == "failed":
        return Entry(
            row.label, row.series, None, "", (), failed=f"failed: {row.failures[0].error}" if row.failures else "no run"
        )
    figures = []
    for key in FIGURES:
        index = summary.column(key)
        if index is not None and row.cells[index].mean is not None:
            column = summary.columns[index]
            figures.append((column.label, f"{row.cells[index].text} {column.unit}".strip()))
    return Entry(row.label, row.series, picture, row.cells[0].text, tuple(figures), best_of_row, best_of_column)


def _best(comparison: Comparison, summary: Summary, placed: Sequence[Row], axis: int) -> set[str]:
    """Methods with the best first metric of their row (axis 0) or column (1), among at least two that are ranked in it."""
    groups: dict[str, list[Row]] = {}
    for row in placed:
        if row.kind == "method" and row.ranked_in(summary.columns[0]) and row.cells[0].mean is not None:
            groups.setdefault(comparison.cells[row.label][axis], []).append(row)
    quantity = summary.columns[0]
    return {min(rows, key=lambda row: quantity.sort_key(_mean(row))).label for rows in groups.values() if len(rows) > 1}


def _mean(row: Row) -> float:
    mean = row.cells[0].mean
    assert mean is not None
    return mean
