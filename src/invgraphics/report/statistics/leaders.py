"""Which method leads a column of a table by more than chance, which is printed bold; which level of a factor leads a study."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import ALL_PAIRS, METHOD, Factor, FailedFit, Observation
from invgraphics.report.statistics.effects import ALPHA, Effect, effects_of, places_of
from invgraphics.report.statistics.intervals import holm
from invgraphics.report.statistics.pairing import Contrast, contrast_words
from invgraphics.report.wording import TIMES, MeasuredQuantity


def leaders(
    comparison: Comparison, means: Sequence[tuple[MeasuredQuantity, Mapping[str, float]]], tables: int = 1
) -> dict[str, tuple[str, Effect]]:
    """Methods that lead a column significantly: better than every other one, corrected over the columns of the page.

    "Better than every other" is one claim, whose p-value is the largest of its pairwise tests (Berger 1982), so that the number
    of methods needs no correction; columns do (Holm), and so do the tables of a page. One seed leads nothing.

    Args:
        comparison: the runs of one scene.
        means: (column, method -> mean) of the methods that are ranked in it.
        tables: tables on the page.

    Returns:
        Column's key -> (its leader, the lead over the next best).
    """
    observations = [Observation(run, comparison.scene, {METHOD: run.method}) for run in comparison.runs]
    found: list[tuple[str, str, Effect]] = []
    p_values: list[float] = []
    for column, values in means:
        if column.better == "none" or len(values) < 2:
            continue
        order = sorted(values, key=lambda name, known=values, key=column.sort_key: key(known[name]))
        effects = effects_of([Contrast(METHOD, other, order[0]) for other in order[1:]], column, observations)
        tested = [_p(effect) for effect in effects]
        known = [p for p in tested if p is not None]
        if len(known) == len(order) - 1:
            found.append((column.key, order[0], effects[0]))
            p_values.append(max(known))
    corrected = holm([min(1.0, tables * p) for p in p_values])
    return {key: (name, lead) for (key, name, lead), p in zip(found, corrected, strict=True) if p is not None and p <= ALPHA}


def lead_contrasts(
    factors: Sequence[Factor],
    quantity: MeasuredQuantity,
    observations: Sequence[Observation],
    lost: Iterable[FailedFit] = (),
    places: tuple[str, Sequence[str]] = ("", ()),
) -> list[Contrast]:
    """Best level against the next best, of factors with too many levels for all pairs, in the family of a study's comparisons.

    Without it such a study says who differs from the reference, but not whether anyone leads. Which levels these are is known
    only afterwards; that makes no false leaders, since of equals the best two lie closer together than two named beforehand.

    Args:
        factors: of the study.
        quantity: whose best is sought.
        observations: finished runs.
        lost: fits that failed; a level that lost any is not ranked.
        places: factor whose levels are answered one by one, and its levels (see `effects.contrasts_of`).
    """
    found, failed = [], tuple(lost)
    many = [factor for factor in factors if len(factor.levels) > ALL_PAIRS and quantity.better != "none"]
    for factor in many:
        for where in places_of(factor, *places):
            # Levels are ranked by their differences from the reference, each on the runs that both have.
            own = [Contrast(factor.path, before, after, where=where) for before, after in factor.pairs()]
            effects = effects_of(own, quantity, observations, failed)
            means = {effect.after: effect.estimate.mean for effect in effects if not effect.lost[1]}
            means |= {} if any(effect.lost[0] for effect in effects) else {factor.reference: 0.0}
            known = [level for level, mean in means.items() if math.isfinite(mean)]
            first, second = (*sorted(known, key=lambda level: quantity.sort_key(means[level])), "", "")[:2]
            if second and factor.reference not in (first, second):  # with which all are compared anyway
                words = factor.named(second, first) or contrast_words(factor.path, second, first)
                found.append(
                    Contrast(factor.path, second, first, where=where, name=f"best in {quantity.label} against next: {words}")
                )
    return found


def _p(effect: Effect) -> float | None:
    """p-value of a lead; 0 for counts that are the same for every seed, which no seed can change."""
    counted = effect.quantity.group == "cost" and effect.quantity.key not in TIMES
    if effect.claim.p is None and counted and effect.estimate.seeds[0] > 1 and effect.estimate.mean != 0:
        return 0.0
    return effect.claim.p if effect.better > 0 else None
