"""Factors of a study, its cells, and the runs that observe the factors' levels."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

from invgraphics.runs.run import Run
from invgraphics.runs.study import Status

METHOD = "method"
"""The method is a factor like any other, under this name."""

ALL_PAIRS = 4
"""Factors with more levels are compared with their reference level, and the best with the next: more pairs cost all power."""


@dataclass(frozen=True)
class Factor:
    """An experimental factor and its levels.

    Attributes:
        path: dotted path of the key, or ``method``.
        levels: its values as written, in the order of the study.
        reference: the level that others are compared with.
        words: level -> what the study calls it.
    """

    path: str
    levels: tuple[str, ...]
    reference: str
    words: Mapping[str, str] = field(default_factory=dict)

    def pairs(self) -> list[tuple[str, str]]:
        """(from, to) pairs of levels that are compared, the reference first."""
        ordered = [self.reference, *(level for level in self.levels if level != self.reference)]
        if len(ordered) <= ALL_PAIRS:
            return list(itertools.combinations(ordered, 2))
        return [(self.reference, level) for level in ordered[1:]]

    def named(self, before: str, after: str) -> str:
        """The study's own words for one level instead of another; empty where it has none."""
        words = self.words.get(after, "")
        if not words or before == self.reference:
            return words
        return f"{words} instead of {self.word(before)}"

    def word(self, level: str) -> str:
        """The study's own words for a level; path and level where it has none, of a method its name."""
        return self.words.get(level) or (level if self.path == METHOD else f"{self.path} {level}")


@dataclass(frozen=True)
class Observation:
    """A run with its scene and its level of every factor, the method included, as written."""

    run: Run
    scene: str
    levels: dict[str, str]


@dataclass(frozen=True)
class FailedFit:
    """A fit that failed, with its scene and its level of every factor; it has no scores, and that must not help its method."""

    scene: str
    levels: dict[str, str]


@dataclass(frozen=True)
class StudyCell:
    """One cell of a study: scene, method, seed and factor levels, with status and run.

    Attributes:
        id: name of its run; cells that come to the same settings share one.
        scene: its scene.
        method: ``renderer/recipe``.
        seed: its seed.
        levels: factor -> level as written, the method included.
        variant: method and levels in words, the same for all scenes and seeds.
        status: ``done``, ``failed``, ``missing``, or ``skipped`` where its data was not there.
        error: why it failed or was skipped; empty otherwise.
        seconds: what it took; ``None`` where unknown.
        run: its run, where it is done.
        label: method, scene@size, budget and seed in a line.
        size: of its pictures: the longest side, or width × height, px; empty for the scene's own.
        budget: of its fit, in words.
        amount: of its budget: (unit, seconds or steps); ``None`` where unknown.
        forecast: seconds that it was expected to take; ``None`` where unknown.
    """

    id: str
    scene: str
    method: str
    seed: int
    levels: dict[str, str]
    variant: str
    status: Status
    error: str
    seconds: float | None
    run: Run | None
    label: str = ""
    size: str = ""
    budget: str = ""
    amount: tuple[str, float] | None = None
    forecast: float | None = None
