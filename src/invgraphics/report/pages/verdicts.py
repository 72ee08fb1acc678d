"""Page of a study's verdicts: headline, matrix of cells, curves, broken rules and all numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.files import write_text
from invgraphics.report.data.assets import Folder
from invgraphics.report.data.factors import StudyCell
from invgraphics.report.data.studies import Study
from invgraphics.report.figures.curve_grid import draw_curve_panels
from invgraphics.report.figures.style import Figure
from invgraphics.report.pages import facts
from invgraphics.report.pages.comparison import markdown_commands, markdown_figures, render
from invgraphics.report.pages.longtable import write_table
from invgraphics.report.pages.study import study_facts
from invgraphics.report.pages.tables import escape_markdown
from invgraphics.report.statistics.clocks import Speeds
from invgraphics.report.statistics.rules import (
    RULES,
    STANDINGS,
    JudgedCell,
    Verdict,
    dead_share,
    headline,
    judge,
    psnr_of,
    unused,
    worst_view,
)
from invgraphics.report.wording import ABSENT
from invgraphics.runs.folder import PUBLISHED
from invgraphics.runs.study import KnownDeviation, StudyRecord
from invgraphics.text import duration

COLUMNS = ("PSNR", "Budget", "Steps", "Fit", "Cell took", "Forecast", "Primitives", "Dead", "Memory", "Forecast")
COLUMNS += ("Worst view", "Code")
UNITS = ("dB", "", "", "s", "", "", "", "", "MB", "MB", "dB", "")


@dataclass(frozen=True)
class VerdictCell:
    """A cell of the matrix of verdicts: score, numbers and links.

    Attributes:
        judged: the cell and its verdicts.
        name: its label without the method, and without the seed where all cells have the same.
        anchor: its place on the page.
        text: its score, or the word that stands there.
        numbers: under ``COLUMNS``.
        files: (name, link) of its run's records.
    """

    judged: JudgedCell
    name: str
    anchor: str
    text: str
    numbers: tuple[str, ...]
    files: tuple[tuple[str, str], ...]

    @property
    def sign(self) -> str:
        """Symbol of the cell's standing, legible without colour."""
        return STANDINGS[self.judged.standing][1]

    @property
    def hint(self) -> str:
        """Tooltip: the cell's standing and broken rules in words."""
        sentences = [STANDINGS[self.judged.standing][0], *(verdict.sentence for verdict in self.judged.red)]
        sentences += [self.judged.cell.error] if self.judged.standing == "skipped" else []
        return f"{self.judged.cell.label}: {' '.join(sentences)}"


@dataclass(frozen=True)
class RuleCount:
    """Numbers of cells that keep a rule, break it for a known cause, and break it."""

    title: str
    ok: int
    known: int
    red: int


@dataclass(frozen=True)
class VerdictPage:
    """Content of the page of verdicts: matrix, curves and stale known deviations.

    Attributes:
        study: what was read.
        fields: every cell, in order.
        rows: (scene, rest of the label, one field per method or ``None``), the matrix.
        figures: curves of each scene and size.
        stale: known deviations that no cell shows any more.
    """

    study: Study
    fields: tuple[VerdictCell, ...]
    rows: tuple[tuple[str, str, tuple[VerdictCell | None, ...]], ...]
    figures: list[Figure]
    stale: tuple[KnownDeviation, ...]

    @property
    def headline(self) -> list[str]:
        """Sentences on the numbers of green, red and skipped cells."""
        return headline([field.judged for field in self.fields])

    @property
    def broken(self) -> list[tuple[VerdictCell, Verdict]]:
        """Every broken rule, those without a known cause first."""
        pairs = [(field, verdict) for field in self.fields for verdict in field.judged.red]
        return sorted(pairs, key=lambda pair: pair[1].outcome == "known")

    @property
    def disturbances(self) -> list[str]:
        """A sentence per cell whose fit had less than its cores, or slower or faster ones than the median fit."""
        runs = [(field.judged.cell.label, field.judged.cell.run) for field in self.fields]
        known = [(label, run) for label, run in runs if run is not None]
        speeds = Speeds.of([run for _, run in known])
        return [f"{label}: {why}." for label, run in known if (why := speeds.disturbance(run))]

    @property
    def counts(self) -> list[RuleCount]:
        """Outcomes counted for each rule."""
        verdicts = [verdict for field in self.fields for verdict in field.judged.verdicts]
        found = {key: [verdict.outcome for verdict in verdicts if verdict.rule == key] for key in RULES}
        return [
            RuleCount(RULES[key], *(all_of.count(kind) for kind in ("ok", "known", "red"))) for key, all_of in found.items()
        ]


def write_verdict_report(study: Study, folder: Folder, source: Path) -> None:
    """Write the page, its Markdown twin and ``verdicts.csv``; records of runs are copied where they lie elsewhere.

    Args:
        study: what was read.
        folder: where to write.
        source: the study's own folder.
    """
    judged = judge(study.cells, study.known)
    fields = tuple(_field(one, _name(one.cell, study), f"cell-{index}", folder) for index, one in enumerate(judged))
    panels: dict[str, list[JudgedCell]] = {}
    for one in judged:
        panels.setdefault(_place(one.cell), []).append(one)
    figures = draw_curve_panels(panels, study.methods, folder.figures)
    page = VerdictPage(study, fields, _matrix(study, fields), figures, unused(judged, study.known))
    folder.publish(source, StudyRecord.FILE, StudyRecord.FILE)
    _write_verdicts(page, folder.root / "verdicts")
    _write_markdown(page, folder)
    machine = facts.plain_facts(study.environment.facts())
    context: dict[str, Any] = {"page": page, "study": study, "environment": study.environment, "machine": machine}
    context |= {"facts_of_study": study_facts(study), "columns": list(zip(COLUMNS, UNITS, strict=True)), "standings": STANDINGS}
    render("verdicts.html", context | {"rules": RULES, "series": {name: i for i, name in enumerate(study.methods)}}, folder)


def _place(cell: StudyCell) -> str:
    """Scene and size in words."""
    return f"{cell.scene}, {cell.size} px" if cell.size else cell.scene


def _name(cell: StudyCell, study: Study) -> str:
    name = cell.label.removeprefix(cell.method).strip()
    return name.removesuffix(f"seed={cell.seed}").strip() if len(study.seeds) == 1 else name


def _field(one: JudgedCell, name: str, anchor: str, folder: Folder) -> VerdictCell:
    cell, run = one.cell, one.cell.run
    psnr = psnr_of(cell)
    text = ABSENT if psnr is None else f"{psnr:.2f}"
    text = {"failed": "failed", "skipped": "skipped", "missing": ABSENT}.get(cell.status, text)
    took, forecast = (ABSENT if value is None else duration(value) for value in (cell.seconds, cell.forecast))
    if run is None:
        rest = [ABSENT] * (len(COLUMNS) - 6)
        return VerdictCell(one, name, anchor, text, (ABSENT, cell.budget, ABSENT, ABSENT, took, forecast, *rest), ())
    worst, share = worst_view(run), dead_share(run)
    numbers = (
        text,
        cell.budget,
        _number(run.scores.cost.get("steps")),
        _number(run.scores.cost.get("fit_seconds")),
        took,
        forecast,
        _number(run.scores.cost.get("primitives")),
        ABSENT if share is None else f"{100 * share:.2g}%",
        _number(run.scores.cost.get("peak_memory_bytes"), 1e-6),
        _number(run.provenance.memory_forecast_bytes, 1e-6),
        ABSENT if worst is None else f"{worst[1]:.2f} ({worst[0]})",
        run.provenance.code_version.rpartition("+")[2] or ABSENT,
    )
    names = [name for name in PUBLISHED if run.files.path(name).is_file()]
    files = tuple((name, folder.publish(run.folder, name, f"runs/{cell.id}/{name}")) for name in names)
    return VerdictCell(one, name, anchor, text, numbers, files)


def _number(value: float | None, scale: float = 1.0) -> str:
    return ABSENT if value is None else f"{value * scale:,.0f}"


def _matrix(study: Study, fields: Sequence[VerdictCell]) -> tuple[tuple[str, str, tuple[VerdictCell | None, ...]], ...]:
    """Rows of the matrix, by scene in the study's order, then size, then budget; one field per method."""
    rows: dict[tuple[str, str], dict[str, VerdictCell]] = {}
    order: dict[tuple[str, str], tuple[Any, ...]] = {}
    for field in fields:
        cell = field.judged.cell
        rest = field.name.partition(" ")[2]
        key = (cell.scene, f"{cell.size + ' px, ' if cell.size else ''}{rest}")
        rows.setdefault(key, {})[cell.method] = field
        width = int(cell.size.partition(" ")[0]) if cell.size else 0
        order[key] = (study.scenes.index(cell.scene), width, cell.amount or ("", 0.0), cell.seed)
    return tuple(
        (scene, rest, tuple(rows[scene, rest].get(method) for method in study.methods))
        for scene, rest in sorted(rows, key=lambda key: order[key])
    )


def _write_verdicts(page: VerdictPage, stem: Path) -> None:
    """Write the long table of verdicts, one row per cell and rule."""
    kinds: dict[str, Any] = dict.fromkeys(("cell", "rule", "outcome"), "text")
    kinds |= {"value": "float", "limit": "float", "sentence": "text", "cause": "text", "issue": "text"}
    rows = []
    for field in page.fields:
        for verdict in field.judged.verdicts:
            row = {"cell": field.judged.cell.label, "rule": verdict.rule, "outcome": verdict.outcome, "value": verdict.value}
            row |= {"limit": verdict.limit, "sentence": verdict.sentence, "cause": verdict.cause, "issue": verdict.issue}
            rows.append(row)
    write_table(kinds, rows, stem)


def _write_markdown(page: VerdictPage, folder: Folder) -> None:
    text = escape_markdown
    lines = [f"# {text(page.study.question or page.study.name)}", "", *(f"- {text(sentence)}" for sentence in page.headline)]
    lines += ["", "| rule | kept | red, cause known | red |", "|---|--:|--:|--:|"]
    lines += [f"| {text(one.title)} | {one.ok} | {one.known} | {one.red} |" for one in page.counts]
    if page.broken:
        lines += ["", "## Broken rules", ""]
        for field, verdict in page.broken:
            cause = (
                f" Known cause: {verdict.cause}{f' (issue {verdict.issue})' if verdict.issue else ''}" if verdict.cause else ""
            )
            sign = "△" if verdict.outcome == "known" else "✗"
            lines.append(f"- {sign} {text(f'{field.judged.cell.method} {field.name}')}: {text(verdict.sentence + cause)}")
    if page.disturbances:
        lines += ["", "## Disturbed clocks", "", *(f"- {text(sentence)}" for sentence in page.disturbances)]
    lines += ["", "## Cells", "", f"PSNR in dB. {', '.join(f'{sign} {words}' for words, sign in STANDINGS.values())}.", ""]
    lines += [f"| scene | | {' | '.join(map(text, page.study.methods))} |", "|---" * (2 + len(page.study.methods)) + "|"]
    for scene, rest, fields in page.rows:
        cells = " | ".join("" if field is None else f"{field.text} {field.sign}" for field in fields)
        lines.append(f"| {text(scene)} | {text(rest)} | {cells} |")
    lines += markdown_figures(page.figures, folder) + markdown_commands([page.study.command])
    write_text(folder.root / "index.md", "\n".join(lines) + "\n")
