"""``invgraphics report``: page, tables and figures from run folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.output import show_table
from invgraphics.errors import InputError

COMPARISON = "compare.json"


@dataclass(frozen=True)
class Report:
    """Write a report from a comparison's folder, or from single runs on the same ground truth."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """The folder of one comparison, or folders of runs."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the comparison's own folder)")] = None
    """Where to write."""

    def run(self) -> int:
        """Write the report; print the page's path."""
        runs = [run for folder in self.folders for run in runs_in(folder)]
        if self.out is not None:
            from invgraphics.report.build import build_from_runs

            print(build_from_runs(runs, self.out))
            return 0
        if len(self.folders) != 1 or not (self.folders[0] / COMPARISON).is_file():
            raise InputError("A report of single runs needs a folder to be written to.", "Give one with --out.")
        write_report(self.folders[0])
        return 0


def runs_in(folder: Path) -> list[Path]:
    """The run that ``folder`` is, or the finished runs of the comparison that it is.

    Raises:
        InputError: it is neither.
    """
    if (folder / "scores.json").is_file():
        return [folder]
    runs = sorted(path.parent for path in folder.glob("runs/*/*/scores.json"))
    if not runs and not (folder / COMPARISON).is_file():
        remedy = "Give a folder that `invgraphics fit` or `invgraphics compare` wrote."
        raise InputError(f"There is no finished run in '{folder}'.", remedy)
    return runs


def write_report(folder: Path) -> None:
    """Write the report of a comparison's folder; print its table and the page's path."""
    from invgraphics.report.build import build_report
    from invgraphics.report.reading import read_comparison
    from invgraphics.report.summary import summarise

    page = build_report(folder)
    comparison = read_comparison(folder)
    summary = summarise(comparison)
    # Quantities down, methods across: there are more of the former, and a terminal is narrow.
    rows = []
    for index, column in enumerate(summary.columns):
        cells = [row.cells[index] for row in summary.rows]
        rows.append([column.heading, *(f"{cell.text} {cell.spread}{' *' if cell.best else ''}".strip() for cell in cells)])
    show_table(f"{comparison.question} (* best)", ["", *(row.label for row in summary.rows)], rows)
    for failure in comparison.failures:
        print(
            f"{failure.method}, seed {failure.seed}, failed: {failure.error.splitlines()[0] if failure.error else 'no message'}"
        )
    print(page)
