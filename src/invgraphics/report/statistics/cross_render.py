"""Cross-rendering: each fit through several renderers, and the picture difference that each approximation makes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from invgraphics.report.data.assets import Folder
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import Factor, Observation
from invgraphics.report.statistics.effects import ALPHA, Effect, effects_of
from invgraphics.report.statistics.intervals import holm
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.summary import quality_columns
from invgraphics.report.statistics.values import value_of
from invgraphics.report.wording import MeasuredQuantity, quality_quantity
from invgraphics.runs.inside import inside
from invgraphics.runs.renderings import OWN, Difference, Renderings
from invgraphics.runs.run import Run, read_run
from invgraphics.runs.study import Approximation
from invgraphics.text import file_name

IDENTICAL = 90.0
"""Pictures closer than this many dB are called the same: they are kept as float16, whose rounding alone is above 75 dB."""
RENDERER = "renderer"
"""The renderer that shows a fit, as a factor."""
SHOWN_VIEW = 0
"""The test view that is shown through every renderer."""


@dataclass(frozen=True)
class CrossRendered:
    """A fit rendered by several renderers, with their pairwise picture differences.

    Attributes:
        fit: the run, whose own renderer is the first of ``seen``.
        seen: renderer -> the run that shows the fit with it.
        differences: two renderers -> how far their pictures and depths are apart.
    """

    fit: Run
    seen: dict[str, Run]
    differences: dict[frozenset[str], Difference]


@dataclass(frozen=True)
class CrossCell:
    """Score of one fit under one renderer.

    Attributes:
        text: its score against the truth.
        difference: of its picture from the fitting renderer's, PSNR in dB; empty for that renderer itself.
        own: whether this is the fitting renderer.
        best: whether this renderer shows the fits better than all others, by more than chance.
        picture: a test view; empty where there is none.
    """

    text: str
    difference: str
    own: bool
    best: bool
    picture: str


@dataclass(frozen=True)
class CrossRow:
    """Scores of one method's fits under every renderer; a cell is ``None`` where it was not rendered."""

    method: str
    series: int
    cells: tuple[CrossCell | None, ...]


@dataclass(frozen=True)
class StepRow:
    """An approximation: the renderers without and with it, and for each method how far their pictures are apart.

    Attributes:
        differences: PSNR between their pictures, dB.
        depths: median difference of depth, world units; empty where a fit has none.
    """

    name: str
    exact: str
    approximate: str
    differences: tuple[str, ...]
    depths: tuple[str, ...]


@dataclass(frozen=True)
class CrossTable:
    """Fit x render table of one scene.

    Attributes:
        quantity: the score against the truth.
        renderers: columns.
        rows: methods that were fitted.
        steps: approximations, where the study names some.
        seeds: fits behind each number.
    """

    quantity: MeasuredQuantity
    renderers: tuple[str, ...]
    rows: tuple[CrossRow, ...]
    steps: tuple[StepRow, ...]
    seeds: int

    @property
    def shows_depth(self) -> bool:
        """Whether differences of depth are known."""
        return any(any(step.depths) for step in self.steps)


def read_renderings(run: Run, clean: Callable[[str], str] = str) -> CrossRendered | None:
    """Read the renderings of a fit by several renderers; ``None`` where there are none.

    Args:
        run: the fit.
        clean: makes names public.

    Raises:
        InputError: a file is missing or broken; the sentence names it.
    """
    if not run.files.has(Renderings):
        return None
    record = run.files.read(Renderings)
    seen = {
        clean(one.renderer): run if one.run == OWN else read_run(inside(run.folder, one.run), run.scores.protocol)
        for one in record.renderings
    }
    differences = {frozenset(clean(name) for name in one.renderers): one for one in record.differences}
    return CrossRendered(run, seen, differences)


def cross_table(
    comparison: Comparison, approximations: Sequence[Approximation], folder: Folder, tables: int = 1
) -> CrossTable | None:
    """Fit x render table of a scene; ``None`` without fits rendered by several renderers.

    Args:
        comparison: the runs of the scene.
        approximations: pairs of renderers.
        folder: of the page.
        tables: such tables on the page, over whose rows the tests of the best renderers are corrected.
    """
    clean = folder.redactor.text if folder.redactor is not None else str
    fits = [found for run in comparison.runs if (found := read_renderings(run, clean)) is not None]
    columns = quality_columns(comparison)
    if not fits or not columns:
        return None
    renderers = tuple(dict.fromkeys(name for fit in fits for name in fit.seen))
    rows, leads = [], []
    for series, method in enumerate(comparison.methods):
        own = [fit for fit in fits if fit.fit.method == method]
        if own:
            cells = tuple(_cell(own, name, columns[0], folder) for name in renderers)
            rows.append(CrossRow(method, series, cells))
            leads.append(_lead(own, renderers, cells, columns[0]))
    rows = _mark_best(rows, renderers, leads, tables)
    groups = [[fit for fit in fits if fit.fit.method == row.method] for row in rows]
    steps = tuple(
        StepRow(
            pair.name,
            exact,
            other,
            tuple(_decibels(group, frozenset((exact, other))) for group in groups),
            tuple(_depth_gap(group, frozenset((exact, other))) for group in groups),
        )
        for pair in approximations
        for exact, other in [(clean(pair.exact), clean(pair.approximate))]
    )
    return CrossTable(columns[0], renderers, tuple(rows), steps, max(map(len, groups)))


def cross_effects(
    observations: Sequence[Observation],
    approximations: Sequence[Approximation],
    factors: Sequence[Factor] = (),
    clean: Callable[[str], str] = str,
) -> list[Effect]:
    """What each approximation does to the score of the *same* fits: paired by fit, averaged over what made them.

    Args:
        observations: the fits of a study.
        approximations: pairs of renderers.
        factors: of the study, whose words name what made the fits.
        clean: makes names public.
    """
    shown = []
    for one in observations:
        if (crossed := read_renderings(one.run, clean)) is not None:
            seen = ((name, replace(run, seed=one.run.seed)) for name, run in crossed.seen.items())
            shown += [Observation(run, one.scene, {**one.levels, RENDERER: name}) for name, run in seen]
    score = next((run.run.scores.quality["psnr"] for run in shown if "psnr" in run.run.scores.quality), None)
    if score is None:
        return []
    pairs = [(pair.name, clean(pair.exact), clean(pair.approximate)) for pair in approximations]
    contrasts = [Contrast(RENDERER, exact, other, name=f"{name} ({other} instead of {exact})") for name, exact, other in pairs]
    return effects_of(contrasts, quality_quantity("psnr", score), shown, factors=factors)


def _score(fits: Sequence[CrossRendered], name: str, quantity: MeasuredQuantity) -> float | None:
    values = [value for fit in fits if name in fit.seen and (value := value_of(fit.seen[name], quantity)) is not None]
    return statistics.fmean(values) if values else None


def _cell(fits: Sequence[CrossRendered], name: str, quantity: MeasuredQuantity, folder: Folder) -> CrossCell | None:
    score = _score(fits, name, quantity)
    if score is None:
        return None
    first = next(fit for fit in fits if name in fit.seen)
    own = first.seen[name] is first.fit
    difference = "" if own else _decibels(fits, None, name)
    path = first.seen[name].files.picture(SHOWN_VIEW)
    place = f"crossed/{file_name(first.fit.method)}-{file_name(name)}.png"
    picture = folder.publish(path.parent, path.name, place) if path.is_file() else ""
    return CrossCell(quantity.text(score), difference, own, best=False, picture=picture)


def _lead(
    fits: Sequence[CrossRendered], renderers: Sequence[str], cells: Sequence[CrossCell | None], quantity: MeasuredQuantity
) -> tuple[str, float | None]:
    """The renderer that shows these fits best, and the p-value of its being better than every other one, paired by fit.

    That is the largest of its pairwise tests (Berger 1982), as where methods lead; ``None`` where nothing is tested.
    """
    scores = {
        name: quantity.sort_key(_score(fits, name, quantity) or 0.0)
        for name, cell in zip(renderers, cells, strict=True)
        if cell
    }
    if len(scores) < 2:
        return "", None
    best = min(scores, key=lambda name: scores[name])
    shown = [
        Observation(replace(run, seed=fit.fit.seed), "", {RENDERER: name}) for fit in fits for name, run in fit.seen.items()
    ]
    effects = [effects_of([Contrast(RENDERER, other, best)], quantity, shown) for other in scores if other != best]
    better = [found[0].claim.p if found and found[0].better > 0 and not found[0].flattered else None for found in effects]
    known = [p for p in better if p is not None]
    return best, max(known) if len(known) == len(better) else None


def _mark_best(
    rows: Sequence[CrossRow], renderers: Sequence[str], leads: Sequence[tuple[str, float | None]], tables: int
) -> list[CrossRow]:
    """Mark the renderers that lead their rows by more than chance, corrected over the rows (Holm) and the page's tables."""
    corrected = holm([None if p is None else min(1.0, tables * p) for _, p in leads])
    marked = []
    for row, (best, _), p in zip(rows, leads, corrected, strict=True):
        named = best if p is not None and p <= ALPHA else ""
        cells = (cell and replace(cell, best=name == named) for name, cell in zip(renderers, row.cells, strict=True))
        marked.append(replace(row, cells=tuple(cells)))
    return marked


def _decibels(fits: Sequence[CrossRendered], pair: frozenset[str] | None, name: str = "") -> str:
    """PSNR between two renderers' pictures, MSE pooled over views and fits; without ``pair``, of ``name`` and the fit's own."""
    squares: list[float] = []
    for fit in fits:
        own = next(iter(fit.seen))
        wanted = frozenset((own, name)) if pair is None else pair
        if wanted <= set(fit.seen):
            squares += [value**2 for value in fit.differences[wanted].rmse] if wanted in fit.differences else []
    if not squares:
        return "–"
    mean = statistics.fmean(squares)
    decibels = math.inf if mean == 0 else -10 * math.log10(mean)
    return "same" if decibels > IDENTICAL else f"{decibels:.1f}"


def _depth_gap(fits: Sequence[CrossRendered], pair: frozenset[str]) -> str:
    """Median difference of depth between two renderers, mean over views and fits."""
    gaps = [gap for fit in fits if pair in fit.differences for gap in fit.differences[pair].depth]
    return f"{statistics.fmean(gaps):.2g}" if gaps else ""
