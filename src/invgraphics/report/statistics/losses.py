"""Fits that a comparison lost: they failed, or diverged, and what is left of their side must not look better for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from invgraphics.report.data.factors import Lost, Observation


def lost_among(gone: Sequence[Lost], known: Sequence[Observation], sides: Sequence[Mapping[str, str]]) -> list[Lost]:
    """The lost fits at some sides' levels whose scene and other levels all sides have, lost or not: others are not missing.

    Args:
        gone: fits that failed or diverged.
        known: fits with a score.
        sides: factor -> level of each side of a comparison.
    """
    named = {factor for side in sides for factor in side}

    def stratum(one: Lost | Observation) -> tuple[Any, ...]:
        return one.scene, *sorted((key, level) for key, level in one.levels.items() if key not in named)

    def at(one: Lost | Observation, side: Mapping[str, str]) -> bool:
        return all(one.levels.get(factor) == level for factor, level in side.items())

    common = set.intersection(*({stratum(one) for one in (*known, *gone) if at(one, side)} for side in sides))
    return [one for one in gone if stratum(one) in common and any(at(one, side) for side in sides)]
