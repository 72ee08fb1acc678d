"""``invgraphics report``: write page, tables and figures from run folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import refuse_idle
from invgraphics.cli.output import columns_that_fit, show_table
from invgraphics.errors import InputError
from invgraphics.runs.comparison import ComparisonRecord, Failure
from invgraphics.runs.folder import RUNS, RunFolder
from invgraphics.runs.inside import inside

if TYPE_CHECKING:
    from invgraphics.report.statistics.summary import Cell, Summary

MOST_ACROSS = 6
"""Most methods that a terminal's table has side by side; more stand below each other."""
FIRST_SHOWN = ("psnr", "ssim", "normal_deg", "chamfer", "fit_seconds", "render_fps", "model_bytes", "primitives")
"""Quantities that come first where a terminal has no room for all."""


@dataclass(frozen=True)
class Report:
    """Write a report from a comparison's folder, from a study's folder, or from single runs on the same ground truth.

    Attributes:
        folders: The folder of one comparison or of one study, or folders of runs.
        out: Where to write; needed for single runs, which have no folder of their own for a report.
        public: Leave out absolute paths, user names and host names; writes to FOLDER-public unless --out says otherwise.
        check: Write nothing: say which of these reports, or of the reports in these folders, were made by recipes that have
            changed.
    """

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN ...", help_behavior_hint="(required)")]
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the folder itself)")] = None
    public: bool = False
    check: bool = False

    def run(self) -> int:
        """Write the report and print the page's path; returns exit status 0, or 1 where a check finds a stale report."""
        from invgraphics.report.data.studies import is_study

        if not self.folders:
            raise InputError("There is nothing to report.", "Give the folder of a comparison, of a study, or of runs.")
        if self.check:
            refuse_idle({"--out": self.out, "--public": self.public or None}, "with --check, which writes nothing")
            return check(self.folders)
        first, alone, out = self.folders[0], len(self.folders) == 1, self.out
        if alone and out is None and self.public:
            out = first.resolve().with_name(f"{first.resolve().name}-public")
        if any(is_study(folder) for folder in self.folders):
            return self._study(first, out)
        if alone and RunFolder(first).has(ComparisonRecord):
            write_report(first, out, self.public)
            return 0
        runs = [run for folder in self.folders for run in runs_in(folder)]
        failures = [one for folder in self.folders for one in failures_in(folder)]
        if out is None:
            raise InputError("A report of single runs needs a folder to be written to.", "Give one with --out.")
        from invgraphics.report.build import build_from_runs

        print(build_from_runs(runs, out, self.public, failures))
        return 0

    def _study(self, folder: Path, out: Path | None) -> int:
        """Write a study's report; prints the effects of its factors and the page's path."""
        if len(self.folders) > 1:
            raise InputError("A study is reported alone.", "Give one study's folder, and nothing else.")
        from invgraphics.report.study import build_study_report, study_sentences

        page = build_study_report(folder, out, self.public)
        for sentence in study_sentences(folder):
            print(sentence)
        print(page)
        return 0


def check(folders: Sequence[Path]) -> int:
    """Print which reports were made by other recipes than today's; returns 1 where some were.

    Raises:
        InputError: a folder is missing, or a record in it is broken.
    """
    from invgraphics.tools.recipe_check import check_recipes, summary

    pages = [page.parent for folder in folders for page in sorted(folder.glob("*/index.html"))]
    single = [folder for folder in folders if (folder / "index.html").is_file() or not any(folder.glob("*/index.html"))]
    found = [check_recipes(folder) for folder in (*single, *pages)]
    for one in found:
        print(one.sentence)
    if len(found) > 1:
        print(summary(found))
    return 0 if all(one.current for one in found if one.runs or len(found) == 1) else 1


def runs_in(folder: Path) -> list[Path]:
    """List the finished runs of a folder: itself if it is a run, else those of the comparison.

    Raises:
        InputError: it is neither.
    """
    if RunFolder(folder).finished:
        return [folder]
    if RunFolder(folder).has(ComparisonRecord):
        return [inside(folder, name) for name in RunFolder(folder).read(ComparisonRecord).runs]
    runs = sorted(run for run in folder.glob(f"{RUNS}/*/*") if RunFolder(run).finished)
    if not runs:
        remedy = "Give a folder that `invgraphics fit` or `invgraphics compare` wrote."
        raise InputError(f"There is no finished run in '{folder}'.", remedy)
    return runs


def failures_in(folder: Path) -> tuple[Failure, ...]:
    """Failed fits of a comparison; none of other folders."""
    return RunFolder(folder).read(ComparisonRecord).failures if RunFolder(folder).has(ComparisonRecord) else ()


def write_report(folder: Path, out: Path | None = None, public: bool = False) -> None:
    """Write a comparison's report into its folder or ``out``; prints its table and the page's path.

    Args:
        folder: of a comparison.
        out: folder of the page; ``None`` for ``folder`` itself.
        public: whether absolute paths, user names and host names are left out.

    Raises:
        InputError: the folder is no comparison, or a file in it is missing or broken.
    """
    from invgraphics.report.build import build_report
    from invgraphics.report.data.comparison import read_comparison
    from invgraphics.report.statistics.summary import summarise

    page = build_report(folder, out, public)
    comparison = read_comparison(folder)
    summary = summarise(comparison)
    show_summary(f"{comparison.question} {summary.legend}".strip(), summary)
    for sentence in dict.fromkeys(run.scores.below_baseline for run in comparison.runs if run.scores.below_baseline):
        print(sentence)
    for failure in comparison.failures:
        print(
            f"{failure.method}, seed {failure.seed}, failed: {failure.error.splitlines()[0] if failure.error else 'no message'}"
        )
    print(page)


def show_summary(title: str, summary: Summary) -> None:
    """Print a comparison's table: quantities down and methods across, or methods down where there are many."""
    names = [row.label for row in summary.rows]
    columns = {
        column.key: [column.heading, *(_text(row.cells[index]) for row in summary.rows)]
        for index, column in enumerate(summary.columns)
    }
    if len(names) <= MOST_ACROSS:
        show_table(title, ["", *names], list(columns.values()))
        return
    ranked = ["", *names], *(columns[key] for key in sorted(columns, key=lambda key: key not in FIRST_SHOWN))
    count = columns_that_fit(ranked)
    headings, *rows = zip(*ranked[:count], strict=True)
    show_table(title, headings, rows)
    if count < len(ranked):
        print(f"Not shown here, as the terminal is too narrow: {', '.join(heading for heading, *_ in ranked[count:])}.")


def _text(cell: Cell) -> str:
    return f"{cell.text} {cell.spread}{' *' if cell.best else ''}".strip()
