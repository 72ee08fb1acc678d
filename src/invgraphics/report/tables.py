"""The summary for other programs: CSV for analysis, Markdown for a repository, LaTeX for a paper."""

from __future__ import annotations

import csv
import math
import os
import re
from pathlib import Path
from typing import Any

from invgraphics.report.records import Comparison, Run
from invgraphics.report.summary import Cell, Row, Summary
from invgraphics.report.wording import COSTS, Quantity, budget_words

CSV_FIELDS: tuple[str, ...] = (
    "scene",
    "method",
    "seed",
    "status",
    "group",
    "metric",
    "value",
    "unit",
    "higher_is_better",
    "views",
    "protocol",
    "run",
    "note",
)

_COST_UNITS = {
    "fit_seconds": "s",
    "render_seconds_per_view": "s",
    "render_fps": "1/s",
    "peak_memory_bytes": "bytes",
    "model_bytes": "bytes",
}


def write_csv(comparison: Comparison, path: Path) -> None:
    """One line per method, seed and metric, in stored units and full precision.

    ``status`` is ``ok``, ``skipped`` (the note says why), ``failed`` (the note is the error) or ``baseline``.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, CSV_FIELDS, restval="")
        writer.writeheader()
        for method in comparison.methods:
            for run in comparison.runs_of(method):
                writer.writerows(_run_lines(run, comparison, path.parent))
            for failure in comparison.failures_of(method):
                line = {"method": method, "seed": failure.seed, "status": "failed", "note": failure.error}
                writer.writerow(line | {"scene": comparison.scene})
        for name, quality in comparison.baselines.items():
            for key, score in quality.items():
                line = {"method": name, "status": "baseline", "group": "quality", "metric": key, "value": _plain(score.mean)}
                line |= {"unit": score.unit, "higher_is_better": str(score.higher_is_better).lower()}
                writer.writerow(line | {"scene": comparison.scene, "views": len(score.per_view) or ""})


def _run_lines(run: Run, comparison: Comparison, folder: Path) -> list[dict[str, Any]]:
    common: dict[str, Any] = {"scene": comparison.scene, "method": run.method, "seed": run.seed}
    common |= {"views": len(run.views), "protocol": run.protocol, "run": relative(run.folder, folder)}
    lines = []
    for key, score in run.quality.items():
        line = {"status": "ok", "group": "quality", "metric": key, "value": _plain(score.mean), "unit": score.unit}
        lines.append(common | line | {"higher_is_better": str(score.higher_is_better).lower()})
    for key, why in run.skipped.items():
        lines.append(common | {"status": "skipped", "group": "quality", "metric": key, "note": why})
    directions = {cost.key: cost.better for cost in COSTS}
    for key, value in run.cost.items():
        line = {"status": "ok", "group": "cost", "metric": key, "value": _plain(value), "unit": _COST_UNITS.get(key, "")}
        better = directions.get(key, "none")
        lines.append(common | line | {"higher_is_better": "" if better == "none" else str(better == "higher").lower()})
    return lines


def relative(path: Path, folder: Path) -> str:
    """``path`` as seen from ``folder``."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _plain(value: float | None) -> str:
    if value is None:
        return ""
    return str(int(value)) if math.isfinite(value) and value == int(value) and abs(value) < 2**53 else repr(value)


def escape_markdown(text: str) -> str:
    """Text that Markdown and the HTML it turns into show as it is."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_\[\]|~#$])", r"\\\1", text)


def markdown_table(summary: Summary) -> str:
    """The summary as a Markdown table: best values bold, baselines italic, footnotes below."""
    head = ["Method", *(escape_markdown(column.heading) for column in summary.columns)]
    lines = [_line(head), _line(["---", *["---:"] * len(summary.columns)])]
    for row in summary.rows:
        name = escape_markdown(row.label)
        cells = [_markdown_cell(cell) for cell in row.cells]
        if row.kind == "failed":
            cells = ["failed", *[""] * (len(summary.columns) - 1)] if cells else []
        lines.append(_line([f"*{name}*" if row.kind == "baseline" else name, *cells]))
    notes = [f"{number}. {escape_markdown(note)}" for number, note in enumerate(summary.notes, 1)]
    return "\n".join([*lines, "", *notes]).rstrip() + "\n"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _markdown_cell(cell: Cell) -> str:
    text = f"**{cell.text}**" if cell.best else cell.text
    text += f" {cell.spread}" if cell.spread else ""
    return f"{text} ({cell.note})" if cell.note else text


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "°": r"$^\circ$",
    "±": r"$\pm$",
    "−": r"$-$",
    "∞": r"$\infty$",
    "–": "--",
}


def escape_latex(text: str) -> str:
    """Text that LaTeX prints as it is."""
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))


def write_latex(comparison: Comparison, summary: Summary, path: Path) -> None:
    """The summary as a ``booktabs`` table, with what a caption must say."""
    budget = f", {budget_words(comparison.budget)} each" if comparison.budget else ""
    views = f"{len(comparison.runs[0].views)} test views" if comparison.runs else "no test views"
    protocol = str(comparison.protocol.get("name", "default"))
    caption = f"Scene {comparison.scene}{budget}; {views}, protocol {protocol}. Best values are bold."
    lines = [
        "% Needs \\usepackage{booktabs}.",
        "\\begin{table}",
        "  \\centering",
        f"  \\caption{{{escape_latex(caption)}}}",
        f"  \\begin{{tabular}}{{l{'r' * len(summary.columns)}}}",
        "    \\toprule",
        _latex_line(["Method", *(escape_latex(column.heading) for column in summary.columns)]),
        "    \\midrule",
        *(_latex_row(row, summary.columns) for row in summary.rows if row.kind != "baseline"),
    ]
    if summary.baselines:
        lines += ["    \\midrule", *(_latex_row(row, summary.columns) for row in summary.baselines)]
    lines += ["    \\bottomrule", "  \\end{tabular}", "\\end{table}"]
    notes = [f"% ({number}) {' '.join(note.split())}" for number, note in enumerate(summary.notes, 1)]
    path.write_text("\n".join([*lines, *notes]) + "\n", encoding="utf-8")


def _latex_line(cells: list[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"


def _latex_row(row: Row, columns: tuple[Quantity, ...]) -> str:
    name = escape_latex(row.label)
    if row.kind == "failed":
        width = max(1, len(columns))
        return _latex_line([name, f"\\multicolumn{{{width}}}{{l}}{{failed}}"])
    return _latex_line([f"\\textit{{{name}}}" if row.kind == "baseline" else name, *map(_latex_cell, row.cells)])


def _latex_cell(cell: Cell) -> str:
    text = escape_latex(cell.text)
    text = f"\\textbf{{{text}}}" if cell.best else text
    text += f" {escape_latex(cell.spread)}" if cell.spread else ""
    return f"{text}\\textsuperscript{{{cell.note}}}" if cell.note else text
