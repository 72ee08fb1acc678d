"""Summary and effects as tables: Markdown for a repository, LaTeX for a paper."""

from __future__ import annotations

import re
from pathlib import Path

from invgraphics.files import write_text
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.pages.across import AcrossScenes
from invgraphics.report.statistics.effects import Effect
from invgraphics.report.statistics.summary import Cell, Row, Summary
from invgraphics.report.wording import MeasuredQuantity, budget_words


def escape_markdown(text: str) -> str:
    """Escape text for Markdown and for the HTML rendered from it."""
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
    "×": r"$\times$",
    "…": r"\ldots{}",
}


def escape_latex(text: str) -> str:
    """Escape text for LaTeX."""
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))


def write_latex(comparison: Comparison, summary: Summary, path: Path) -> None:
    """Write the summary as a ``booktabs`` table with a self-contained caption."""
    budget = f", {budget_words(comparison.budget)} each" if comparison.budget else ""
    views = f"{len(comparison.runs[0].scores.views)} test views" if comparison.runs else "no test views"
    protocol = str(comparison.protocol.get("name", "default"))
    caption = f"Scene {comparison.scene}{budget}; {views}, protocol {protocol}. Bold: leads all others by more than chance."
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
    write_text(path, "\n".join([*lines, *notes]) + "\n")


def _latex_line(cells: list[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"


def _latex_row(row: Row, columns: tuple[MeasuredQuantity, ...]) -> str:
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


EFFECT_HEADS = ("Factor", "Levels", "Difference", "95%, these scenes", "95%, scenes like these", "p (Holm)", "Based on")


def effect_cells(effect: Effect) -> list[str]:
    """Table cells of an effect, under ``EFFECT_HEADS``."""
    unit = f" {effect.quantity.unit}" if effect.quantity.unit else ""
    corrected = "" if effect.adjusted is None else f"{effect.adjusted:.2g}"
    mean = f"{effect.text(effect.estimate.mean)}{unit}"
    where = ", ".join([*effect.contrast.where.values(), effect.contrast.name or effect.factor])
    levels = f"{effect.after} − {effect.before}"
    if effect.contrast.against is not None:
        factor, low, high = effect.contrast.against
        levels += f", at {factor} {high} − {low}"
    based = f"{effect.estimate.size}, {effect.disturbed} left out: clock" if effect.disturbed else effect.estimate.size
    return [where, levels, mean, effect.interval, effect.across_interval, corrected, based]


def markdown_effects(effects: list[Effect]) -> str:
    """Effects as a Markdown table; significant differences are bold."""
    lines = [_line(list(EFFECT_HEADS)), _line(["---", "---", "---:", "---:", "---:", "---:", "---"])]
    for effect in effects:
        cells = [escape_markdown(text) for text in effect_cells(effect)]
        cells[2] = f"**{cells[2]}**" if effect.found else cells[2]
        lines.append(_line(cells))
    return "\n".join(lines) + "\n"


def markdown_across(table: AcrossScenes) -> list[str]:
    """A table across scenes as lines of Markdown."""
    lines = [
        _line(["Variant", *map(escape_markdown, table.scenes), "mean"]),
        _line(["---", *["---:"] * (len(table.scenes) + 1)]),
    ]
    for row in table.rows:
        name = f"{row.variant} ({row.refused})" if row.refused else row.variant
        lines.append(_line([escape_markdown(name), *map(table.text, row.values), table.text(row.mean)]))
    return lines


def effects_caption(effects: list[Effect]) -> str:
    """Caption of a table of effects: quantity, interval, and family of Holm's correction."""
    quantity, family = effects[0].quantity, effects[0].comparisons
    unit = f" ({quantity.unit})" if quantity.unit else ""
    text = f"Differences in {quantity.label}{unit} with 95% intervals, for new fits on these scenes and for scenes like these."
    bold = f"Bold: significant at a family-wise 5% (Holm's correction over {family} comparisons)"
    return f"{text} {bold}, with no scene or setting that has the opposite sign significantly."


def write_latex_effects(effects: list[Effect], caption: str, path: Path) -> None:
    """Write effects as a ``booktabs`` table; significant differences are bold."""
    lines = [
        "% Needs \\usepackage{booktabs}.",
        "\\begin{table}",
        "  \\centering",
        f"  \\caption{{{escape_latex(caption)}}}",
        "  \\begin{tabular}{llrrrrl}",
        "    \\toprule",
        _latex_line([escape_latex(head) for head in EFFECT_HEADS]),
        "    \\midrule",
    ]
    for effect in effects:
        cells = [escape_latex(text) for text in effect_cells(effect)]
        cells[2] = f"\\textbf{{{cells[2]}}}" if effect.found else cells[2]
        lines.append(_latex_line(cells))
    lines += ["    \\bottomrule", "  \\end{tabular}", "\\end{table}"]
    write_text(path, "\n".join(lines) + "\n")
