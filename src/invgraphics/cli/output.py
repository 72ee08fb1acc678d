"""What commands print on standard output: tables."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

PIPED_WIDTH = 160
"""Columns where there is no terminal that could say how many it has."""


def show_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; its first column is never broken."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, no_wrap=index == 0, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False, markup=False)
    console.print(title, style="bold")
    console.print(table)


def show_scores(scores: Mapping[str, Any]) -> None:
    """Print a run's scores, and what could not be computed."""
    rows = [
        (name, f"{score['mean']:.4g}", score["unit"], "higher" if score["higher_is_better"] else "lower")
        for name, score in scores["quality"].items()
    ]
    title = f"{scores['method']} on {scores['scene']}, {len(scores['views'])} test views, protocol {scores['protocol']}"
    show_table(title, ("metric", "mean", "unit", "better"), rows)
    if "test_poses" in scores:
        print(f"Test poses: {scores['test_poses']}. Pose errors are medians over the training views.")
    for name, why in scores["skipped"].items():
        print(f"{name}: {why}")
    if "shortfall" in scores:
        print(scores["shortfall"])
