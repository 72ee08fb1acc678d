"""Failed and diverged fits of a comparison: what is left of their side must not look better for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from invgraphics.report.data.factors import FailedFit, Observation
from invgraphics.report.statistics.values import without_score
from invgraphics.report.wording import MeasuredQuantity


def scoreless(observations: Sequence[Observation], quantity: MeasuredQuantity) -> list[Observation]:
    """Finished fits that failed at a quantity: they diverged, or lack a metric that another seed at the same levels has."""
    cells: dict[tuple[Any, ...], list[Observation]] = {}
    for one in observations:
        cells.setdefault((one.scene, *sorted(one.levels.items())), []).append(one)
    found = []
    for cell in cells.values():
        failed = set(map(id, without_score([one.run for one in cell], quantity)))
        found += [one for one in cell if id(one.run) in failed]
    return found


def failures_among(
    gone: Sequence[FailedFit], known: Sequence[Observation], sides: Sequence[Mapping[str, str]]
) -> list[FailedFit]:
    """The failed fits at some sides' levels whose scene and other levels all sides have, failed or not: others are not missing.

    Args:
        gone: fits that failed or diverged.
        known: fits with a score.
        sides: factor -> level of each side of a comparison.
    """
    named = {factor for side in sides for factor in side}

    def stratum(one: FailedFit | Observation) -> tuple[Any, ...]:
        return one.scene, *sorted((key, level) for key, level in one.levels.items() if key not in named)

    def at(one: FailedFit | Observation, side: Mapping[str, str]) -> bool:
        return all(one.levels.get(factor) == level for factor, level in side.items())

    common = set.intersection(*({stratum(one) for one in (*known, *gone) if at(one, side)} for side in sides))
    return [one for one in gone if stratum(one) in common and any(at(one, side) for side in sides)]
