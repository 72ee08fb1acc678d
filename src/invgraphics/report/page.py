"""The HTML page and its Markdown twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.report import facts
from invgraphics.report.assets import Folder
from invgraphics.report.pictures import ViewPage, has_flip, publish_truth
from invgraphics.report.records import Comparison
from invgraphics.report.style import SERIES, Figure
from invgraphics.report.summary import Reach, Summary
from invgraphics.report.tables import escape_markdown, markdown_table
from invgraphics.report.wording import Quantity, listing

TINY = 320
"""Pictures narrower than this are enlarged on the page, with hard pixel edges: what is compared is pixels."""


@dataclass(frozen=True)
class Drawn:
    """Everything that was drawn for a page.

    Attributes:
        curves: time to quality.
        tradeoffs: quality against each cost.
        distributions: per metric, its spread over views.
        views: the chosen test views.
    """

    curves: Figure | None
    tradeoffs: list[Figure]
    distributions: list[tuple[Quantity, Figure]]
    views: tuple[ViewPage, ...]


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of the truth; ``anchor`` is empty where the page does not show that view in full."""

    url: str
    name: str
    anchor: str


def write_html(
    comparison: Comparison, summary: Summary, told: list[str], reach: Reach | None, drawn: Drawn, root: Path
) -> None:
    """Write ``index.html``: one file with its style and script inside, its pictures beside it."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    folder = Folder(root)
    environment = Environment(
        loader=PackageLoader("invgraphics.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    context: dict[str, Any] = {
        "comparison": comparison,
        "summary": summary,
        "groups": _groups(summary),
        "verdict": told,
        "reach": reach,
        "drawn": drawn,
        "url": folder.url,
        "thumbnails": _thumbnails(comparison, drawn, folder),
        "protocol_facts": facts.protocol_facts(comparison),
        "scene_facts": facts.scene_facts(comparison),
        "scene_summary": facts.scene_sentence(comparison, "summary"),
        "scene_stresses": facts.scene_sentence(comparison, "stresses"),
        "shared_facts": facts.shared_facts(comparison),
        "cells": facts.reproduction(comparison, folder),
        "palette": SERIES,
        "tiny": bool(drawn.views) and drawn.views[0].width < TINY,
        "several_seeds": any(row.seeds > 1 for row in summary.rows if row.kind == "method"),
        "has_flip": has_flip(),
        "has_values": lambda row, columns: any(row.cells[index].mean is not None for index in columns),
    }
    html = environment.get_template("page.html").render(context)
    (root / "index.html").write_text(html, encoding="utf-8")


def _groups(summary: Summary) -> list[tuple[str, str, list[int]]]:
    """(heading, explanation, columns) of the tables: pictures with costs first, geometry apart so that both fit a page."""
    columns = list(enumerate(summary.columns))
    pictures = [index for index, column in columns if column.group != "geometry"]
    geometry = [index for index, column in columns if column.group == "geometry"]
    groups = [("", "", pictures)]
    if geometry:
        groups.append(("Geometry", "Depth and normals are scored where truth and prediction are both opaque.", geometry))
    return groups


def _thumbnails(comparison: Comparison, drawn: Drawn, folder: Folder) -> list[Thumbnail]:
    if not comparison.runs:
        return []
    run, shown = comparison.runs[0], {view.index for view in drawn.views}
    return [
        Thumbnail(publish_truth(run, index, folder), name, f"view-{index}" if index in shown else "")
        for index, name in enumerate(run.views)
    ]


def write_markdown(comparison: Comparison, summary: Summary, told: list[str], drawn: Drawn, root: Path) -> None:
    """Write ``index.md``: the same answer for a repository's front page."""
    folder, text = Folder(root), escape_markdown
    parts = [f"# {text(comparison.question)}", *(f"- {text(sentence)}" for sentence in told)]
    settings = "; ".join(f"{name}: {value}" for name, value in facts.protocol_facts(comparison))
    stated = comparison.protocol.get("summary")
    parts += [
        "",
        f"Scene **{text(comparison.scene)}**. {text(settings)}." + (f" Protocol: {text(str(stated))}." if stated else ""),
    ]
    parts += ["", "## Summary", "", markdown_table(summary)]
    parts += [f"Not computed: {text(listing(labels))} ({text(why)})." for why, labels in summary.skipped.items()]
    if comparison.failures:
        parts += ["## Failures", ""]
        parts += [f"- {text(cell.method)}, seed {cell.seed}: {text(cell.error)}" for cell in comparison.failures]
    figures = [*([drawn.curves] if drawn.curves else []), *drawn.tradeoffs, *(figure for _, figure in drawn.distributions)]
    parts += ["", "## Figures", ""] if figures else []
    parts += [f"![{text(figure.alt)}]({folder.url(figure.path)})" for figure in figures]
    parts += ["", "## Provenance", "", *(f"- {text(name)}: {text(value)}" for name, value in facts.shared_facts(comparison))]
    commands = [comparison.command, *(cell.command for cell in facts.reproduction(comparison, folder))]
    commands = [" ".join(command.split("\n")) for command in commands if command]
    if commands:
        parts += ["", "## Reproduce", "", *(f"    {command}" for command in commands)]
    (root / "index.md").write_text("\n".join(parts) + "\n", encoding="utf-8")
