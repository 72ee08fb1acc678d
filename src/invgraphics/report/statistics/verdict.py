"""Verdict on a comparison in sentences: ranking, significance of the lead, costs and warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, Observation
from invgraphics.report.statistics.effects import ALPHA, effects_of
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.rules import DEAD_SHARE
from invgraphics.report.statistics.sentences import detectable_words
from invgraphics.report.statistics.summary import Row, Summary
from invgraphics.report.wording import MeasuredQuantity, budget_words, grouped, listing, times
from invgraphics.runs.run import Run

EXACT_POINTS = "exact surface points"
"""How the notes of a rendered scene call points that were taken from its truth."""


def verdict(comparison: Comparison, summary: Summary) -> list[str]:
    """Sentences on ranking, significance, costs and warnings, in order of importance."""
    sentences = [*_quality(comparison, summary), *_costs(summary), *_warnings(comparison, summary)]
    return [sentence for sentence in sentences if sentence]


def _ranking(summary: Summary, column: MeasuredQuantity) -> list[tuple[float, Row]]:
    """(value, row) of the methods that have all their seeds, best first."""
    rows = [row for row in summary.methods if row.ranked_in(column)]
    values = [(cell.mean, row) for row in rows if (cell := summary.cell(row, column.key)) and cell.mean is not None]
    return sorted(values, key=lambda entry: column.sort_key(entry[0]))


def _quality(comparison: Comparison, summary: Summary) -> list[str]:
    columns = [column for column in summary.columns if column.group != "cost"]
    ranking = _ranking(summary, columns[0]) if columns else []
    if not ranking:
        return []
    column, (value, winner) = columns[0], ranking[0]
    given = f"Given {budget_words(comparison.budget)} each, " if comparison.budget else ""
    unit = f" {column.unit}" if column.unit else ""
    extreme = "highest" if column.better == "higher" else "lowest"
    once = " in the one fit there is of each" if _one_seed(ranking) else ""
    record = f"the {extreme} {column.label}{once}," if len(ranking) > 1 else f"a {column.label} of"
    sentence = f"{given}{winner.label} reaches {record} {column.text(value)}{unit}"
    gaps = []
    if len(ranking) > 1:
        gaps.append((abs(value - ranking[1][0]), f"ahead of {ranking[1][1].label}"))
    reference = _best_baseline(summary, column)
    if reference is not None:
        ahead = column.sort_key(value) < column.sort_key(reference[0])
        gaps.append(
            (
                abs(value - reference[0]),
                f"{'ahead of' if ahead else 'behind'} the better trivial baseline ({reference[1].label})",
            )
        )
    if column.key == "psnr" and comparison.noise_ceiling is not None:
        side = "below" if value < comparison.noise_ceiling else "above"
        name = f"{side} the truth's own noise level ({column.text(comparison.noise_ceiling)}{unit})"
        gaps.append((abs(comparison.noise_ceiling - value), name))
    worded = [f"{column.text(gap)}{unit} {where}" for gap, where in gaps]
    sentence += f": {listing(worded)}." if worded and math.isfinite(value) else "."
    return [sentence, _resolution(comparison, summary, column, ranking), _other_metrics(summary, columns[1:], winner)]


def _best_baseline(summary: Summary, column: MeasuredQuantity) -> tuple[float, Row] | None:
    found = [(cell.mean, row) for row in summary.baselines if (cell := summary.cell(row, column.key)) and cell.mean is not None]
    return min(found, key=lambda entry: column.sort_key(entry[0])) if found else None


def _one_seed(ranking: list[tuple[float, Row]]) -> bool:
    return max(row.seeds for _, row in ranking) < 2


def _resolution(comparison: Comparison, summary: Summary, column: MeasuredQuantity, ranking: list[tuple[float, Row]]) -> str:
    """Sentence on the interval of the first method's lead over the second, and its significance over seeds."""
    if len(ranking) < 2:
        return ""
    if _one_seed(ranking):
        return "One seed per method is an observation, which names no winner: another seed may turn the order round."
    first, second = (row.label for _, row in ranking[:2])
    runs = [Observation(run, comparison.scene, {METHOD: run.method}) for run in comparison.runs]
    effects = effects_of([Contrast(METHOD, second, first)], column, runs)
    if not effects or effects[0].estimate.unit == "none":
        return ""
    lead, unit = effects[0], f" {column.unit}" if column.unit else ""
    size = f"{lead.estimate.size[0].upper()}{lead.estimate.size[1:]}"
    low, high = sorted((abs(lead.estimate.low), abs(lead.estimate.high)))
    if lead.found:
        sentence = f"Over {lead.estimate.size} that lead lies in [{lead.text(low)}, {lead.text(high)}]{unit} (95% interval"
        if (cell := summary.cell(ranking[0][1], column.key)) and cell.best:
            return f"{sentence})."
        return f"{sentence} of this pair alone; that it leads all others is not beyond chance, corrected for all columns)."
    # Any of the others could have come second, and the closest is chosen after the fact (Bonferroni over them).
    chosen = math.inf if lead.equivalence is None else lead.equivalence * (len(ranking) - 1)
    if lead.equivalent and chosen <= ALPHA and column.margin is not None:
        return f"Over {lead.estimate.size} the two are equal within {lead.text(column.margin)}{unit} (equivalence test)."
    return f"{size} cannot tell that lead from chance: {detectable_words(lead)}."


def _other_metrics(summary: Summary, columns: list[MeasuredQuantity], winner: Row) -> str:
    """Metrics that a method leads by more than chance."""
    agree: list[str] = []
    others: dict[str, list[str]] = {}
    for column in columns:
        best = [row for row in summary.methods if (cell := summary.cell(row, column.key)) and cell.best]
        for row in best:
            (agree if row is winner else others.setdefault(row.label, [])).append(column.label)
    parts = [f"It also leads in {listing(agree)}" if agree else ""]
    parts += [f"{who} leads in {listing(labels)}" for who, labels in others.items()]
    text = "; ".join(part for part in parts if part)
    return f"{text}." if text else ""


def _costs(summary: Summary) -> list[str]:
    words = {
        "render_fps": "renders fastest",
        "model_bytes": "has the smallest model",
        "peak_memory_bytes": "needs the least memory",
    }
    parts = []
    for column in summary.columns:
        ranking = _ranking(summary, column) if column.key in words else []
        if len(ranking) < 2:
            continue
        (value, row), (second, _) = ranking[0], ranking[1]
        if not ((cell := summary.cell(row, column.key)) and cell.best):
            continue
        ratio = _lead_ratio(value, second, column)
        if math.isfinite(ratio) and ratio >= 1.05:
            parts.append(
                f"{row.label} {words[column.key]} ({column.text(value)} {column.unit}, {times(ratio)}× better than the next)"
            )
    text = "; ".join(parts)
    return [f"{text}."] if text else []


def _lead_ratio(best: float, second: float, column: MeasuredQuantity) -> float:
    """Factor by which the best value of a cost is better than the second; infinite beside zero."""
    if column.better == "lower" and best:
        return second / best
    return best / second if second else math.inf


def unequal_start(runs: Sequence[Run]) -> list[str]:
    """A warning where methods with primitives may start from points that no method could have found, and others do not."""
    exact = [run for run in runs if EXACT_POINTS in str(run.provenance.notes.get("points", ""))]
    explicit = {run.scores.method: None for run in exact if run.scores.cost.get("primitives")}
    if not explicit or set(explicit) == {run.scores.method for run in runs}:
        return []
    names = listing(explicit)
    return [
        f"The start is not equal: {names} may begin on exact surface points of the scene, which no method could find and "
        "others do not use; `--set data.init=sfm` or `data.init=random` makes it equal."
    ]


def _unequal_budgets(comparison: Comparison) -> list[str]:
    budgets = [(budget_words(run.provenance.budget), run.method) for run in comparison.runs if run.provenance.budget]
    if comparison.budget or len({budget for budget, _ in budgets}) < 2:
        return []
    return [f"The budgets are not equal: {grouped(budgets)}. A lead may be that of the longer fit."]


def _warnings(comparison: Comparison, summary: Summary) -> list[str]:
    sentences = _unequal_budgets(comparison) + unequal_start(comparison.runs)
    columns = [column for column in summary.columns if column.group != "cost"]
    reference = _best_baseline(summary, columns[0]) if columns else None
    if reference is not None:
        column = columns[0]
        below = [
            row.label for value, row in _ranking(summary, column) if column.sort_key(value) >= column.sort_key(reference[0])
        ]
        if below:
            sentences.append(f"{listing(below)} did not beat the trivial baseline '{reference[1].label}' in {column.label}.")
    dead = [run for run in comparison.runs if (run.scores.cost.get("dead") or 0) > DEAD_SHARE]
    for run in dead:
        share = f"{100 * (run.scores.cost['dead'] or 0):.2g} %"
        sentences.append(f"No gradient can change {share} of the primitives of {run.method} (seed {run.seed}).")
    reasons: dict[str, str] = {}
    for run in comparison.runs:
        if run.scores.below_baseline:
            reasons.setdefault(run.method, run.scores.below_baseline)
    sentences += reasons.values()
    if columns and (broken := [row.label for row in summary.methods if columns[0].key in row.lost]):
        what = "a fit" if len(broken) == 1 else "fits"
        sentences.append(f"{listing(broken)}: {what} without a number for {columns[0].label}, and so left out of the ranking.")
    short = [row.label for row in summary.methods if not row.complete]
    if short:
        words = "lacks seeds that others have and is" if len(short) == 1 else "lack seeds that others have and are"
        sentences.append(f"{listing(short)} {words} left out of the ranking.")
    if comparison.failures:
        cells = len(comparison.runs) + len(comparison.failures)
        sentences.append(f"{len(comparison.failures)} of {cells} cells failed; they are listed below the table.")
    return sentences
