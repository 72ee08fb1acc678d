"""Report of a study: factor effects, interactions, tables and figures of every scene, and the matrix of cells."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from invgraphics.report.data.assets import Folder, writing
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD
from invgraphics.report.data.redact import check_runs_outside, redactor_for
from invgraphics.report.data.studies import Study, read_study, scene_comparisons
from invgraphics.report.figures.analyses import draw_analyses
from invgraphics.report.figures.effects import draw_heat_maps
from invgraphics.report.pages.longtable import write_study_table
from invgraphics.report.pages.parts import draw_contrasts, draw_part
from invgraphics.report.pages.study import StudyPage, write_study_html, write_study_markdown
from invgraphics.report.pages.tables import effects_caption, write_latex, write_latex_effects
from invgraphics.report.pages.verdicts import write_verdict_report
from invgraphics.report.statistics.cross_render import cross_effects
from invgraphics.report.statistics.effects import Effect, contrasts_of, effects_of
from invgraphics.report.statistics.leaders import lead_contrasts
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.predictions import judge_predictions
from invgraphics.report.statistics.rules import headline, judge
from invgraphics.report.statistics.sentences import effect_sentence, unmeasured_sentences, unscored_sentences
from invgraphics.report.statistics.summary import quality_columns, table_columns
from invgraphics.report.statistics.values import value_of
from invgraphics.report.wording import MeasuredQuantity
from invgraphics.text import file_name

MOST_PICTURES = 8
"""Variants of a scene that get pictures and curves; there are as many colours."""


def build_study_report(folder: Path, out: Path | None = None, public: bool = False) -> Path:
    """Write the report of a study, finished or not.

    Args:
        folder: what ``ablate`` wrote.
        out: where to write; ``None`` for the study's own folder.
        public: leave out everything private, which needs a folder of its own.

    Returns:
        The page, ``index.html``; beside it lie ``index.md``, ``results.csv`` and ``.parquet``, ``effects.tex``, a
        ``table-*.tex`` for each scene, and ``figures/``; of a study that judges its cells, ``verdicts.csv`` instead.

    Raises:
        InputError: a file is missing or broken, or the folder cannot be written.
    """
    study, target = read_study(folder), folder if out is None else out
    redactor = None
    if public:
        check_runs_outside(target, [folder])
        redactor = redactor_for([study], study.scenes)
        study = redactor.value(study)
    place = Folder(target, redactor=redactor)
    with writing(target):
        if study.report == "verdicts":
            write_study_table(study, target / "results", folder)
            write_verdict_report(study, place, folder)
            return target / "index.html"
        page = _draw(study, place, folder)
        write_study_table(study, target / "results", folder)
        for part in page.parts:
            write_latex(part.comparison, part.summary, target / f"table-{part.key}.tex")
        if page.contrasts.tables:
            write_latex_effects(page.contrasts.first, effects_caption(page.contrasts.first), target / "effects.tex")
        write_study_markdown(page, place)
        write_study_html(page, place)
    return target / "index.html"


def study_sentences(folder: Path) -> list[str]:
    """Factor effects on a study's metric, a sentence per pair of levels; of a study of verdicts, its headline.

    Before them stands what the study asks about and was not measured: its metric, interactions.

    Raises:
        InputError: a file is missing or broken.
    """
    study = read_study(folder)
    if study.report == "verdicts":
        return headline(judge(study.cells, study.known))
    quantities = _quantities(study, scene_comparisons(study))
    effects = headline_effects(study, quantities[0]) if quantities else []
    missing = unscored_sentences(study.metric, quantities[0] if quantities else None)
    missing += unmeasured_sentences(study.interactions, effects, study.factors, study.observations())
    return [*missing, *map(effect_sentence, effects)]


def headline_effects(study: Study, quantity: MeasuredQuantity, clean: Callable[[str], str] = str) -> list[Effect]:
    """The effects that answer a study's question: of approximations on the same fits where it names some, then of levels."""
    observations = study.observations()
    crossed = cross_effects(observations, study.approximations, study.factors, clean)
    asked = effects_of(study_contrasts(study, quantity), quantity, observations, study.lost(), study.factors)
    return [*crossed, *asked]


def study_contrasts(study: Study, quantity: MeasuredQuantity | None) -> list[Contrast]:
    """The comparisons that a study's question asks for, and what leads in the first quantity where there are many levels."""
    among = study.methods if study.each == METHOD else ()
    among = among or next((factor.levels for factor in study.factors if factor.path == study.each), ())
    each = study.each if among else ""
    asked = contrasts_of(study.factors, each, study.interactions, among)
    if quantity is None:
        return asked
    return [*asked, *lead_contrasts(study.factors, quantity, study.observations(), study.lost(), (each, among))]


def _draw(study: Study, folder: Folder, root: Path) -> StudyPage:
    comparisons = scene_comparisons(study)
    keys = _keys([comparison.scene for comparison in comparisons])
    shown = [replace(comparison, shown=shown_variants(comparison)) for comparison in comparisons]
    parts = tuple(
        draw_part(comparison, replace(folder, part=key), study.approximations, len(comparisons))
        for key, comparison in zip(keys, shown, strict=True)
    )
    observations = study.observations()
    quantities = _quantities(study, comparisons)
    asked = study_contrasts(study, quantities[0] if quantities else None)
    contrasts = draw_contrasts(quantities, asked, (observations, study.lost()), folder, study.factors)
    clean = folder.redactor.text if folder.redactor is not None else str
    crossed = cross_effects(observations, study.approximations, study.factors, clean)
    heat = draw_heat_maps(study.factors, quantities[0], observations, folder.figures) if quantities else []
    analyses = draw_analyses(root, study.analyses, folder.figures)
    judged = judge_predictions(study.predictions, observations, study.lost(), study.scenes)
    return StudyPage(study, parts, contrasts, heat, quantities[0] if quantities else None, analyses, crossed, judged)


def _quantities(study: Study, comparisons: Sequence[Comparison]) -> list[MeasuredQuantity]:
    """Union of the columns of all scenes' tables with the study's margins: its metric, other qualities, costs.

    Empty where nothing has a quality.
    """
    columns = [column for comparison in comparisons for column in table_columns(comparison)]
    found = {column.key: column for column in reversed(columns)}
    keys = dict.fromkeys(column.key for column in columns)
    unique = [replace(found[key], margin=study.margins.get(key, found[key].margin)) for key in keys]
    quality = sorted((column for column in unique if column.group != "cost"), key=lambda column: column.key != study.metric)
    return [*quality, *(column for column in unique if column.group == "cost")] if quality else []


def _keys(scenes: Sequence[str]) -> list[str]:
    """Unique names of scenes for HTML anchors and folders."""
    names = [file_name(scene).strip("-") or "scene" for scene in scenes]
    return [name if names.count(name) == 1 else f"{name}-{index}" for index, name in enumerate(names)]


def shown_variants(comparison: Comparison) -> tuple[str, ...]:
    """The variants that get pictures: all, or ``MOST_PICTURES`` evenly spaced from best to worst."""
    columns = quality_columns(comparison)
    if len(comparison.methods) <= MOST_PICTURES or not columns:
        return ()
    ranked: list[tuple[float, str]] = []
    for method in comparison.methods:
        values = [value for run in comparison.runs_of(method) if (value := value_of(run, columns[0])) is not None]
        if values:
            ranked.append((columns[0].sort_key(statistics.fmean(values)), method))
    ranked.sort()
    count = min(MOST_PICTURES, len(ranked))
    return tuple(ranked[round(i * (len(ranked) - 1) / max(1, count - 1))][1] for i in range(count))
