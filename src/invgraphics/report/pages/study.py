"""The HTML page of a study and its Markdown twin."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from invgraphics.files import write_text
from invgraphics.report.data.assets import Folder
from invgraphics.report.data.factors import METHOD, StudyCell
from invgraphics.report.data.studies import Study
from invgraphics.report.data.variants import base_words
from invgraphics.report.figures.analyses import AnalysisPart
from invgraphics.report.figures.style import Figure
from invgraphics.report.pages import facts
from invgraphics.report.pages.across import across_scenes
from invgraphics.report.pages.comparison import markdown_commands, markdown_figures, markdown_part, render
from invgraphics.report.pages.parts import Contrasts, Part
from invgraphics.report.pages.tables import escape_markdown, markdown_across, markdown_effects
from invgraphics.report.statistics.effects import Effect
from invgraphics.report.statistics.intervals import CONFIDENCE, POWER
from invgraphics.report.statistics.predictions import PREDICTION_HEADS, JudgedPrediction, predictions_sentence
from invgraphics.report.statistics.sentences import effect_sentence, unmeasured_sentences, unscored_sentences
from invgraphics.report.statistics.values import value_of
from invgraphics.report.statistics.verdict import unequal_start
from invgraphics.report.wording import MeasuredQuantity, budget_words, listing
from invgraphics.text import duration

DESIGNS = {
    "factorial": "full factorial: every combination of all levels",
    "scoped": "factorial within each method: every combination of its own factors' levels, the others at their base",
    "one-at-a-time": "one factor at a time: all others stay at their base level",
    "list": "an explicit list of combinations",
}


@dataclass(frozen=True)
class StudyPage:
    """Content of a study's page: scenes, effects, heat maps and analyses.

    Attributes:
        study: what was read.
        parts: each scene.
        contrasts: the factors' effects.
        heat: heat maps of pairs of factors.
        quantity: the metric that sentences, plots and the matrix are about; ``None`` where nothing ran.
        analyses: computations beside the fits.
        crossed: what approximations do to the scores of the same fits; empty where a study compares none.
        predictions: the statements made beforehand, judged.
    """

    study: Study
    parts: tuple[Part, ...]
    contrasts: Contrasts
    heat: list[Figure]
    quantity: MeasuredQuantity | None
    analyses: list[AnalysisPart]
    crossed: list[Effect] = field(default_factory=list)
    predictions: list[JudgedPrediction] = field(default_factory=list)

    @property
    def headline(self) -> list[str]:
        """Unfinished cells, a sentence per comparison that the question asks for, and the population of the intervals."""
        effects, study = [*self.crossed, *self.contrasts.first], self.study
        judged = [predictions_sentence(self.predictions)] if self.predictions else []
        missing = unscored_sentences(study.metric, self.quantity)
        missing += unmeasured_sentences(study.interactions, effects, study.factors, study.observations())
        start = unequal_start([cell.run for cell in study.cells if cell.run])
        return [*_progress(study), *judged, *missing, *map(effect_sentence, effects), *start, *_scope(self)]


@dataclass(frozen=True)
class MatrixCell:
    """One field of the matrix of cells: ``status``, score or status word, link and tooltip."""

    status: str
    text: str
    link: str
    hint: str


@dataclass(frozen=True)
class MatrixRow:
    """A variant and its fields, scene by scene and seed by seed; a field is ``None`` where the design has no such cell."""

    variant: str
    cells: tuple[MatrixCell | None, ...]


def write_study_html(page: StudyPage, folder: Folder) -> None:
    """Write the page of a study."""
    study = page.study
    context: dict[str, Any] = {
        "page": page,
        "study": study,
        "contrasts": page.contrasts,
        "parts": page.parts,
        "environment": study.environment,
        "facts_of_study": study_facts(study),
        "matrix": _matrix(page, folder),
        "across": across_scenes(study, page.quantity),
        "failures": [(index, cell) for index, cell in enumerate(study.cells) if cell.status == "failed"],
        "design": design_words(study),
        "machine": facts.plain_facts(study.environment.facts()),
        "cells": {
            part.key: facts.reproduction(part.comparison, Folder(folder.root, part.key, folder.redactor)) for part in page.parts
        },
        "prediction_heads": PREDICTION_HEADS,
        "rules": {"percent": f"{100 * CONFIDENCE:g}", "power": f"{100 * POWER:g}", "margins": _margins(page)},
    }
    render("study.html", context, folder)


def design_words(study: Study) -> str:
    """The design in words: a full factorial where every combination of levels was planned, whatever the study calls itself.

    Factors of some methods only leave combinations out, so that a study which calls itself factorial need not be a full one.
    """
    combined = {tuple(cell.levels.get(factor.path) for factor in study.factors) for cell in study.cells}
    if study.factors and len(combined) == math.prod(len(factor.levels) for factor in study.factors):
        return DESIGNS["factorial"]
    scoped = study.design == "factorial" and any(":" in factor.path for factor in study.factors)
    return DESIGNS["scoped" if scoped else study.design]


def _margins(page: StudyPage) -> str:
    """Margins of the equivalence tests in words."""
    known = [(one, one.margin) for one, _ in page.contrasts.tables if one.margin is not None]
    return listing(f"{one.text(margin)}{f' {one.unit}' if one.unit else ''} of {one.label}" for one, margin in known)


def study_facts(study: Study) -> facts.Facts:
    """(name, value) facts of the design: scenes, methods, seeds, cells, budget and presets."""
    entries = {
        "scenes": listing(study.scenes),
        "methods": listing(study.methods),
        "base, from which variants are named by what differs": base_words(study.factors),
        "seeds": ", ".join(map(str, study.seeds)),
        "cells": _counted(study),
        "budget per fit": _of_the_cells(study, "budget", study.budget),
        **facts.preset_facts([replace(cell.run, method=cell.method) for cell in study.cells if cell.run], study.preset),
        "picture size": _of_the_cells(study, "size", study.size),
        "points to start from": facts.start_fact([cell.run for cell in study.cells if cell.run]),
        "region of the fits": facts.region_fact([cell.run for cell in study.cells if cell.run]),
    }
    return tuple((name, value) for name, value in entries.items() if value)


def _of_the_cells(study: Study, setting: Literal["budget", "size"], stated: str) -> str:
    """All values in words that cells have of a setting; empty where it is a crossed factor, among which its levels stand."""
    if study.design != "list" and any(factor.path == setting for factor in study.factors):
        return ""
    own = dict.fromkeys(getattr(cell, setting) for cell in study.cells)
    return listing(budget_words(value) for value in own if value) or budget_words(stated)


def _counted(study: Study) -> str:
    parts = [f"{study.count(status)} {status}" for status in ("done", "failed", "missing", "skipped") if study.count(status)]
    return ", ".join(parts)


def _progress(study: Study) -> list[str]:
    failed, missing, total = study.count("failed"), study.count("missing"), len(study.cells)
    sentences = []
    if missing:
        verb = "has" if missing == 1 else "have"
        sentences.append(f"{missing} of {total} cells {verb} not run yet: what follows may change.")
    if failed:
        sentences.append(f"{failed} of {total} cells failed: see below the matrix. Paired comparisons omit them.")
    versions = {cell.run.provenance.code_version for cell in study.cells if cell.run}
    if len(versions) > 1:
        sentences.append(f"Cells were made by {len(versions)} versions of the code; each run's facts name its own.")
    fits = [cell.run.provenance for cell in study.cells if cell.run]
    threads = sorted({one.threads for one in fits if one.threads and one.budget and "step" not in one.budget})
    if len(threads) > 1:
        sentences.append(f"Fits of equal seconds had {listing(map(str, threads))} threads, and so unequal numbers of steps.")
    if skipped := [cell for cell in study.cells if cell.status == "skipped"]:
        reasons = listing(dict.fromkeys(cell.error for cell in skipped))
        sentences.append(f"{len(skipped)} of {total} cells were skipped: {reasons}.")
    return sentences


def _scope(page: StudyPage) -> list[str]:
    """Sentence on the populations that the intervals generalise to."""
    effects = [effect for effect in [*page.crossed, *page.contrasts.first] if effect.claim.unit != "none"]
    if not effects:
        return []
    metric = f"Differences are of {listing(dict.fromkeys(effect.quantity.label for effect in effects))}. "
    if all(effect.across is None for effect in effects):
        return [f"{metric}The unit is the seed: intervals hold for new fits on this scene, and say nothing of other scenes."]
    scenes = "other scenes like these (the unit is the scene)"
    if all(effect.estimate.unit == "none" for effect in effects):
        return [f"{metric}Intervals hold for {scenes}; how far new fits on these would spread is not known."]
    words = "Two intervals answer two questions: for new fits on these scenes, each counted equally (the unit is the seed); "
    return [f"{metric}{words}and for {scenes}, on which a verdict rests."]


def _matrix(page: StudyPage, folder: Folder) -> list[MatrixRow]:
    study = page.study
    places = {(cell.variant, cell.scene, cell.seed): index for index, cell in enumerate(study.cells)}
    rows = []
    for variant in study.variants:
        found = [places.get((variant, scene, seed)) for scene in study.scenes for seed in study.seeds]
        fields = tuple(None if i is None else _field(study.cells[i], i, page.quantity, folder) for i in found)
        rows.append(MatrixRow(variant, fields))
    return rows


def _field(cell: StudyCell, index: int, quantity: MeasuredQuantity | None, folder: Folder) -> MatrixCell:
    where = f"{cell.variant}, {cell.scene}, seed {cell.seed}"
    took = f", {duration(cell.seconds)}" if cell.seconds is not None else ""
    if cell.status == "failed":
        return MatrixCell("failed", "failed", f"#failure-{index}", f"{where}: {cell.error.splitlines()[0]}")
    if cell.status == "skipped":
        return MatrixCell("missing", "skipped", "", f"{where}: {cell.error}")
    if cell.run is None:
        return MatrixCell("missing", "–", "", f"{where}: has not run")
    value = value_of(cell.run, quantity) if quantity is not None else None
    text = "done" if value is None or quantity is None else quantity.text(value)
    return MatrixCell(
        "done", text, folder.publish(cell.run.folder, cell.run.scores.file, f"cells/{index:04d}.json"), f"{where}: done{took}"
    )


def write_study_markdown(page: StudyPage, folder: Folder) -> None:
    """Write ``index.md``, the page in Markdown for a repository."""
    study, text = page.study, escape_markdown
    lines = [f"# {text(study.question or study.name)}", "", *(f"- {text(sentence)}" for sentence in page.headline)]
    lines += ["", "## Design", "", f"{text(design_words(study))}.", ""]
    lines += [f"- {text(name)}: {text(value)}" for name, value in study_facts(study)]
    lines += [f"- {text(_factor_word(factor.path))}: {text(', '.join(factor.levels))}" for factor in study.factors]
    if page.predictions:
        rows = [PREDICTION_HEADS, ("---",) * len(PREDICTION_HEADS), *(judged.cells for judged in page.predictions)]
        lines += ["", "## Predictions", "", *(f"| {' | '.join(map(text, row))} |" for row in rows)]
    if page.contrasts.tables:
        lines += ["", "## Effects", "", markdown_effects(page.contrasts.first)]
    if page.crossed:
        lines += ["", "## The same fits through two renderers", "", markdown_effects(page.crossed)]
    if across := across_scenes(study, page.quantity):
        lines += [
            "",
            "## Across scenes",
            "",
            f"{text(across.quantity.heading)}, mean over seeds.",
            "",
            *markdown_across(across),
        ]
    for part in page.parts:
        lines += ["", f"## Scene {text(part.comparison.scene)}", "", *markdown_part(part)]
    if page.analyses:
        lines += ["", "## Approximations by themselves", ""]
        lines += [f"- {text(part.sentence)}" for part in page.analyses]
    if study.failures:
        lines += ["", "## Failures", ""]
        lines += [f"- {text(f'{cell.variant}, {cell.scene}, seed {cell.seed}: {cell.error}')}" for cell in study.failures]
    figures = [*([page.contrasts.figure] if page.contrasts.figure else []), *page.heat]
    figures += [part.figure for part in page.analyses]
    lines += markdown_figures(figures + [figure for part in page.parts for figure in part.drawn.figures], folder)
    lines += markdown_commands([study.command])
    write_text(folder.root / "index.md", "\n".join(lines) + "\n")


def _factor_word(path: str) -> str:
    return "method" if path == METHOD else path
