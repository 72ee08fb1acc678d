"""Which method leads a column of a table by more than chance: what is printed bold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, Observation
from invgraphics.report.statistics.effects import ALPHA, Effect, effects_of
from invgraphics.report.statistics.intervals import holm
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.wording import TIMES, Quantity


def leaders(
    comparison: Comparison, means: Sequence[tuple[Quantity, Mapping[str, float]]], tables: int = 1
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


def _p(effect: Effect) -> float | None:
    """p-value of a lead; 0 for counts that are the same for every seed, which no seed can change."""
    counted = effect.quantity.group == "cost" and effect.quantity.key not in TIMES
    if effect.claim.p is None and counted and effect.estimate.seeds[0] > 1 and effect.estimate.mean != 0:
        return 0.0
    return effect.claim.p if effect.better > 0 else None
