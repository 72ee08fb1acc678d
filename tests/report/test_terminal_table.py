"""A comparison's table on the terminal: methods side by side while they are few, below each other where they are many."""

from dataclasses import replace
from pathlib import Path

import pytest

from invgraphics.cli.output import PIPED_WIDTH
from invgraphics.cli.report import FIRST_SHOWN, show_summary
from invgraphics.report.data.comparison import read_comparison
from invgraphics.report.statistics.summary import Row, Summary, summarise


@pytest.fixture(scope="module")
def summary(pristine_comparison: Path) -> Summary:
    return summarise(read_comparison(pristine_comparison))


def test_few_methods_stand_side_by_side(summary: Summary, capsys: pytest.CaptureFixture[str]) -> None:
    show_summary("title", summary)
    out = capsys.readouterr().out
    assert "Not shown" not in out
    for index, column in enumerate(summary.columns):
        line = next(line for line in out.splitlines() if line.strip().startswith(column.heading))
        assert [cell.text in line for cell in (row.cells[index] for row in summary.rows)] == [True] * len(summary.rows)


def test_many_methods_stand_below_each_other(summary: Summary, capsys: pytest.CaptureFixture[str]) -> None:
    """Thirty side by side were one character wide."""
    rows = tuple(replace(row, label=f"{row.label}-{turn}") for turn in range(6) for row in summary.rows)
    show_summary("title", replace(summary, rows=rows))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[:-1])) <= PIPED_WIDTH
    for row in rows:
        (line,) = (line for line in lines if line.split()[:1] == [row.label.split()[0]] and row.label in line)
        psnr = summary.cell(row, "psnr")
        assert psnr is not None
        assert psnr.text in line.split()
        assert "".join(line.split()).endswith("".join(_last_shown(summary, row, lines[-1]).split()))
    shown = [column.heading for column in summary.columns if column.heading not in lines[-1]]
    left = [column.heading for column in summary.columns if column.heading in lines[-1]]
    assert bool(left) == lines[-1].startswith("Not shown here")
    assert len(shown) > 6


def _last_shown(summary: Summary, row: Row, left: str) -> str:
    """The text in the last column that is shown: a line that is too long would be cut there."""
    order = sorted(summary.columns, key=lambda column: column.key not in FIRST_SHOWN)
    shown = [column for column in order if column.heading not in left]
    cell = summary.cell(row, shown[-1].key)
    assert cell is not None
    return f"{cell.text} {cell.spread}{' *' if cell.best else ''}"
