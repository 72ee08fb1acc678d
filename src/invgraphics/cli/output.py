"""Tables on standard output."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from invgraphics.runs.scores import Scores

NO_TRUTH = "the scene has no true "
"""How the reason begins for which a metric of geometry has no value."""
PIPED_WIDTH = 160
"""Characters of a line where there is no terminal that could say how many it has."""
GAP = 4
"""Characters between two columns of a table."""


def columns_that_fit(columns: Sequence[Sequence[str]]) -> int:
    """Count the columns, from the first one on, for whose cells and headings' words one line of the terminal has room.

    Args:
        columns: heading and texts of each.
    """
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else PIPED_WIDTH
    used = 0
    for count, (heading, *texts) in enumerate(columns):
        used += max(map(len, [*heading.split(), *texts]), default=0) + GAP
        if used > width:
            return count
    return len(columns)


def show_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column is never wrapped.

    Args:
        title: line above the table.
        columns: headings.
        rows: texts, one per column.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, no_wrap=index == 0, overflow="fold", min_width=max(map(len, column.split()), default=0))
    for row in rows:
        table.add_row(*row)
    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False, markup=False)
    console.print(title, style="bold")
    console.print(table)


def show_scores(scores: Scores) -> None:
    """Print a run's scores and costs, and the metrics that were skipped."""
    rows = [
        (name, "-" if score.mean is None else f"{score.mean:.4g}", score.unit, "higher" if score.higher_is_better else "lower")
        for name, score in scores.quality.items()
    ]
    title = f"{scores.method} on {scores.scene}, {len(scores.views)} test views, protocol {scores.protocol}"
    show_table(title, ("metric", "mean", "unit", "better"), rows)
    if scores.test_poses:
        print(f"Test poses: {scores.test_poses}. Pose errors are medians over the training views.")
    if scores.test_exposure:
        print(f"Test views' exposure: {scores.test_exposure}.")
    if scores.skipped:
        print(not_scored(scores.skipped))
    if scores.below_baseline:
        print(scores.below_baseline)


def not_scored(skipped: Mapping[str, str]) -> str:
    """Format the skipped metrics and their reasons in a line, grouped by reason.

    Args:
        skipped: metric -> reason, as in `Scores.skipped`.
    """
    reasons: dict[str, list[str]] = {}
    for name, why in skipped.items():
        absent = why.removeprefix(NO_TRUTH)
        reasons.setdefault(NO_TRUTH if absent != why else why, []).append(absent if absent != why else name)
    parts = [f"{', '.join(names)}: {why}" for why, names in reasons.items() if why != NO_TRUTH]
    if NO_TRUTH in reasons:
        parts.insert(0, NO_TRUTH + ", ".join(dict.fromkeys(reasons[NO_TRUTH])))
    return f"Not scored ({len(skipped)} metrics): {'; '.join(parts)}."
