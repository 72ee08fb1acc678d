"""Factors of a study and the runs that observe their levels."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from typing import Any

from invgraphics.report.data.records import Run

METHOD = "method"
"""The method is a factor like any other, under this name."""

ALL_PAIRS = 4
"""Factors with more levels are compared with their reference level only: every further pair costs all others power."""


@dataclass(frozen=True)
class Factor:
    """Something that a study varies.

    Attributes:
        path: dotted path of the key, or ``method``.
        levels: its values as written, in the order of the study.
        reference: the level that others are compared with.
    """

    path: str
    levels: tuple[str, ...]
    reference: str

    def pairs(self) -> list[tuple[str, str]]:
        """(from, to) pairs of levels that are compared, the reference first."""
        ordered = [self.reference, *(level for level in self.levels if level != self.reference)]
        if len(ordered) <= ALL_PAIRS:
            return list(itertools.combinations(ordered, 2))
        return [(self.reference, level) for level in ordered[1:]]


@dataclass(frozen=True)
class Observation:
    """A run and where it stands in the study: ``levels`` holds every factor, the method included, as written."""

    run: Run
    scene: str
    levels: dict[str, str]


def level_text(value: Any) -> str:
    """A level as people write it; equal values give equal text."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e6:
        value = int(value)
    return json.dumps(value, sort_keys=True)
