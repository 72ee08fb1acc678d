"""The HTML page of a comparison and its Markdown twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from invgraphics.files import write_text
from invgraphics.report.data.assets import Folder
from invgraphics.report.figures.style import SERIES, Figure
from invgraphics.report.figures.views import has_flip
from invgraphics.report.pages import facts
from invgraphics.report.pages.matrix import Matrix, method_matrix
from invgraphics.report.pages.parts import Contrasts, Part
from invgraphics.report.pages.tables import escape_markdown, markdown_effects, markdown_table
from invgraphics.report.statistics.cross_render import CrossTable
from invgraphics.report.wording import listing

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _templates() -> Environment:
    """The pages' templates, each compiled once."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("invgraphics.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, context: Mapping[str, Any], folder: Folder) -> None:
    """Write ``index.html``: one file with its style and script inside, its pictures beside it."""
    shared = {"url": folder.url, "palette": SERIES, "has_flip": has_flip(), "public": folder.redactor is not None}
    html = _templates().get_template(template).render({**shared, **context})
    write_text(folder.root / "index.html", html)


def write_html(part: Part, contrasts: Contrasts, folder: Folder) -> None:
    """Write the page of a comparison."""
    comparison, matrix = part.comparison, method_matrix(part)
    context: dict[str, Any] = {
        "comparison": comparison,
        "part": part,
        "contrasts": contrasts,
        "matrix": matrix,
        "environment": comparison.environment,
        "protocol_facts": facts.protocol_facts(comparison),
        "scene_facts": facts.scene_facts(comparison),
        "scene_summary": facts.scene_sentence(comparison, "summary"),
        "scene_stresses": facts.scene_sentence(comparison, "stresses"),
        "inconsistent_poses": facts.scene_sentence(comparison, "inconsistent_poses"),
        "shared_facts": facts.shared_facts(comparison),
        "cells": facts.reproduction(comparison, folder),
    }
    render("page.html", context, folder)


def write_markdown(part: Part, contrasts: Contrasts, folder: Folder) -> None:
    """Write ``index.md``, the page in Markdown for a repository."""
    comparison, text = part.comparison, escape_markdown
    parts = [f"# {text(comparison.question)}", *(f"- {text(sentence)}" for sentence in part.verdict)]
    settings = "; ".join(f"{name}: {value}" for name, value in facts.protocol_facts(comparison))
    stated = comparison.protocol.get("summary")
    inconsistency = facts.scene_sentence(comparison, "inconsistent_poses")
    parts += ["", f"**The camera poses are suspicious.** {text(inconsistency)}"] if inconsistency else []
    parts += [
        "",
        f"Scene **{text(comparison.scene)}**. {text(settings)}." + (f" Protocol: {text(str(stated))}." if stated else ""),
    ]
    parts += ["", "## Summary", "", *markdown_part(part)]
    parts += markdown_matrix(method_matrix(part))
    if comparison.failures:
        parts += ["## Failures", ""]
        parts += [f"- {text(cell.method)}, seed {cell.seed}: {text(cell.error)}" for cell in comparison.failures]
    if contrasts.tables:
        parts += ["", "## Differences between methods", "", *(f"- {text(one)}" for one in contrasts.sentences)]
        parts += ["", markdown_effects(contrasts.first)]
    parts += markdown_figures([*([contrasts.figure] if contrasts.figure else []), *part.drawn.figures], folder)
    parts += ["", "## Provenance", "", *(f"- {text(name)}: {text(value)}" for name, value in facts.shared_facts(comparison))]
    parts += markdown_commands([comparison.command, *(cell.command for cell in facts.reproduction(comparison, folder))])
    write_text(folder.root / "index.md", "\n".join(parts) + "\n")


def markdown_part(part: Part) -> list[str]:
    """Summary table of a scene in Markdown, with skipped metrics and the reasons."""
    lines = [markdown_table(part.summary), *(f"**{escape_markdown(text)}**\n" for text in part.summary.disturbances)]
    for why, labels in part.summary.skipped.items():
        lines.append(f"Not computed: {escape_markdown(listing(labels))} ({escape_markdown(why)}).")
    return lines + markdown_cross_table(part.cross_table)


def markdown_matrix(matrix: Matrix | None) -> list[str]:
    """Table of methods, field by renderer, in Markdown below a heading, and the methods left out; empty without one."""
    if matrix is None:
        return []
    text, quantity = escape_markdown, matrix.quantity
    lines = ["## The table", "", f"{text(quantity.heading)} of each method, field by renderer.", ""]
    lines += [f"| field | {' | '.join(map(text, matrix.columns))} |", "|---" * (1 + len(matrix.columns)) + "|"]
    for field, cells in matrix.rows:
        entries = [", ".join(f"{text(entry.method)} {entry.score or '(failed)'}" for entry in cell) for cell in cells]
        lines.append(f"| {text(field)} | {' | '.join(entries)} |")
    left_out = [f"- {text(one.method)}: {text(one.reason)}" for one in matrix.refused]
    return [*lines, "", *(["Left out:", "", *left_out, ""] if left_out else [])]


def markdown_cross_table(crossed: CrossTable | None) -> list[str]:
    """Fit x render table in Markdown, with the picture difference of each approximation; empty without one."""
    if crossed is None:
        return []
    text = escape_markdown
    lines = ["", f"{text(crossed.quantity.heading)} of each fit (row) through each renderer (column); in brackets the image "]
    lines[-1] += "difference from the fitting renderer, dB."
    lines += ["", f"| fitted by | {' | '.join(map(text, crossed.renderers))} |", "|---" * (1 + len(crossed.renderers)) + "|"]
    for row in crossed.rows:
        cells = [
            "–" if cell is None else f"{cell.text}{f' ({cell.difference})' if cell.difference else ''}" for cell in row.cells
        ]
        lines.append(f"| {text(row.method)} | {' | '.join(cells)} |")
    if crossed.steps:
        names = " | ".join(text(row.method) for row in crossed.rows)
        lines += ["", "Image difference that one approximation makes, dB", ""]
        lines[-2] += ", and median difference of depth, units of the scene." if crossed.shows_depth else "."
        lines += [f"| approximation | {names} |", "|---" * (1 + len(crossed.rows)) + "|"]
        for step in crossed.steps:
            pairs = zip(step.differences, step.depths, strict=True)
            cells = [f"{value}, {depth}" if depth else value for value, depth in pairs]
            lines.append(f"| {text(step.name)} | {' | '.join(cells)} |")
    return lines


def markdown_figures(figures: Sequence[Figure], folder: Folder) -> list[str]:
    """Plots as Markdown images below a heading; empty without plots."""
    lines = ["", "## Figures", ""] if figures else []
    return lines + [f"![{escape_markdown(figure.alt)}]({folder.url(figure.path)})" for figure in figures]


def markdown_commands(commands: Sequence[str]) -> list[str]:
    """Commands as a Markdown code block below a heading; empty without commands."""
    known = [" ".join(command.split("\n")) for command in commands if command]
    return ["", "## Reproduce", "", *(f"    {command}" for command in known)] if known else []
