"""Which runs a contrast compares, and with which values: same scene, same views, same other levels; diverged fits are counted.

Seeds of one method share their random draws where only a setting differs, so that they pair. Seeds of different methods have
nothing in common but the number: they are two independent groups.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.data.factors import METHOD, FailedFit, Observation
from invgraphics.report.data.variants import level_words
from invgraphics.report.statistics.failures import failures_among, scoreless
from invgraphics.report.statistics.intervals import Estimate, over_scenes, over_seeds
from invgraphics.report.statistics.values import run_values, value_of
from invgraphics.report.wording import MeasuredQuantity

Sign = float


@dataclass(frozen=True)
class Contrast:
    """A comparison to be tested: ``after`` minus ``before`` of a factor, or how that differs between two levels of another.

    Attributes:
        factor: dotted path, or ``method``.
        before: level that is subtracted.
        after: level that it is subtracted from.
        where: factor -> the only level that is included.
        against: (factor, level, level) for an interaction: the difference at the second level minus that at the first.
        name: what the contrast is called, where the levels of ``factor`` alone do not say, as of an interaction.
    """

    factor: str
    before: str
    after: str
    where: Mapping[str, str] = field(default_factory=dict)
    against: tuple[str, str, str] | None = None
    name: str = ""

    @property
    def label(self) -> str:
        """The contrast in words."""
        words = self.name or contrast_words(self.factor, self.before, self.after)
        return ", ".join(self.where.values()) + ": " + words if self.where else words

    @property
    def levels(self) -> tuple[str, str]:
        """The levels that are compared, before and after."""
        return self.before, self.after

    @property
    def sides(self) -> list[dict[str, str]]:
        """Levels of the compared factors that fits are taken from: of the two sides, or of an interaction's four corners."""
        sides = [{self.factor: level} for level in self.levels]
        if self.against is None:
            return sides
        factor, *places = self.against
        return [{**side, factor: place} for side in sides for place in places]

    @property
    def independent(self) -> bool:
        """Whether the two sides are independent groups of fits: different methods, whose seeds do not pair."""
        return METHOD in (self.factor, self.against[0] if self.against else "")

    def takes(self, one: Observation | FailedFit) -> bool:
        """Whether a fit is at the levels of one of its sides."""
        included = all(one.levels.get(key) == level for key, level in self.where.items())
        return included and any(all(one.levels.get(key) == level for key, level in side.items()) for side in self.sides)


def contrast_words(factor: str, before: str, after: str) -> str:
    """Contrast of two levels in words: ``data.train_views 20 instead of 40``; of a switch ``no clone``."""
    if {before, after} == {"true", "false"}:
        return level_words(factor, after)
    return f"{after} instead of {before}" if factor == METHOD else f"{factor} {after} instead of {before}"


@dataclass(frozen=True)
class Sample:
    """Values of a contrast.

    Attributes:
        scenes: scene -> signed groups of values, one value per fit.
        lost: scene -> diverged or failed fits that are (subtracted, added): of (before, after), or of an interaction's corners.
        silent: scenes where one side has no number at all.
        pairs: fits compared, on the side that has fewer.
        truths_differ: some were scored against different pictures, because the factor changes the truth.
        scores: the largest magnitude of a score that was compared.
    """

    scenes: dict[str, list[tuple[Sign, Float[ndarray, " fit"]]]]
    lost: dict[str, tuple[int, int]]
    silent: tuple[str, ...]
    pairs: int
    truths_differ: bool
    scores: float

    @property
    def whole(self) -> Estimate | None:
        """The difference over new fits on these scenes; ``None`` without any."""
        return over_seeds(list(self.scenes.values()), scores=self.scores)

    @property
    def alone(self) -> dict[str, Estimate]:
        """The same of each scene by itself; empty for one scene."""
        scenes = self.scenes.items() if len(self.scenes) > 1 else ()
        return {name: own for name, groups in scenes if (own := over_seeds([groups], scores=self.scores)) is not None}

    @property
    def across(self) -> Estimate | None:
        """The difference over scenes as a sample of scenes; ``None`` for one scene."""
        if len(self.scenes) < 2 or (whole := self.whole) is None:
            return None
        return over_scenes(list(self.scenes.values()), least_error=whole.error, scores=self.scores)

    @property
    def all_lost(self) -> tuple[int, int]:
        """Failed fits of all scenes that are (subtracted, added)."""
        return sum(one for one, _ in self.lost.values()), sum(one for _, one in self.lost.values())


Table = dict[tuple[Any, ...], dict[int, Observation]]
"""(scene, other levels) -> seed -> run."""


def sample(
    contrast: Contrast, quantity: MeasuredQuantity, observations: Sequence[Observation], lost: Iterable[FailedFit] = ()
) -> Sample:
    """Collect the values of a contrast from a study's runs.

    Args:
        contrast: what is compared.
        quantity: in which.
        observations: finished runs.
        lost: fits that failed.
    """
    counted = [one for one in observations if all(one.levels.get(key) == level for key, level in contrast.where.items())]
    sided = [one for one in counted if one.levels.get(contrast.factor, "") in contrast.levels]
    failed = scoreless(sided, quantity)
    gone = [FailedFit(one.scene, one.levels) for one in failed]
    left_out = set(map(id, failed))
    known = [one for one in sided if id(one) not in left_out and value_of(one.run, quantity) is not None]
    gone += [cell for cell in lost if all(cell.levels.get(key) == value for key, value in contrast.where.items())]
    gone = failures_among(gone, known, contrast.sides)
    differ = False
    scenes: dict[str, list[tuple[Sign, ndarray]]] = {}
    pairs = 0
    for scene in dict.fromkeys(one.scene for one in known):
        here = [one for one in known if one.scene == scene]
        groups = _interaction(contrast, quantity, here) if contrast.against else _difference(contrast, quantity, here)
        if groups:
            scenes[scene] = groups
            pairs += min(len(values) for _, values in groups)
            differ |= len({one.run.provenance.truth_sha256 for one in here}) > 1
    losses = {
        scene: _counted(contrast, [cell for cell in gone if cell.scene == scene])
        for scene in dict.fromkeys(cell.scene for cell in gone)
    }
    silent = tuple(scene for scene in losses if scene not in scenes)
    scores = max((abs(value) for one in known if math.isfinite(value := value_of(one.run, quantity) or 0.0)), default=0.0)
    return Sample(scenes, losses, silent, pairs, differ, scores)


def _counted(contrast: Contrast, gone: Sequence[FailedFit]) -> tuple[int, int]:
    """Numbers of lost fits that are (subtracted, added)."""
    raised = sum(_raises(contrast, cell) for cell in gone)
    return len(gone) - raised, raised


def _raises(contrast: Contrast, cell: FailedFit) -> bool:
    """Whether losing a fit may raise the estimate, as the worst go first: those that are added, not those subtracted."""
    added = cell.levels.get(contrast.factor) == contrast.after
    if contrast.against is None:
        return added
    factor, _, high = contrast.against
    return added == (cell.levels.get(factor) == high)


def _difference(contrast: Contrast, quantity: MeasuredQuantity, here: Sequence[Observation]) -> list[tuple[Sign, ndarray]]:
    """Signed groups of one scene: a single group of paired differences, or one group per side."""
    before, after = (_table(contrast.factor, level, here) for level in (contrast.before, contrast.after))
    shared = [key for key in before if key in after]
    if not shared:
        return []
    if contrast.independent:
        sides = (_side(table, other, shared, quantity) for table, other in ((after, before), (before, after)))
        groups = [(sign, values) for sign, values in zip((1.0, -1.0), sides, strict=True) if len(values)]
        return groups if len(groups) == 2 else []
    values = balanced(_differences(before, after, quantity))
    return [(1.0, np.array(list(values.values())))] if values else []


def _interaction(contrast: Contrast, quantity: MeasuredQuantity, here: Sequence[Observation]) -> list[tuple[Sign, ndarray]]:
    """Differences of paired differences; two independent groups of them where one factor is the method."""
    assert contrast.against is not None
    factor, low, high = contrast.against
    if contrast.factor == METHOD:  # the difference of differences is the same either way round
        swapped = Contrast(factor, low, high, contrast.where, (METHOD, contrast.before, contrast.after))
        return _interaction(swapped, quantity, here)
    corners = []
    for level in (high, low):
        kept = [one for one in here if one.levels.get(factor) == level]
        corners.append([_table(contrast.factor, side, kept, drop=factor) for side in (contrast.before, contrast.after)])
    # Both differences are over the same levels of all other factors, of which a list or an unfinished study has not all.
    shared = set.intersection(*(set(table) for tables in corners for table in tables))
    if factor != METHOD or shared:  # a method may have factors that another has not
        corners = [[{key: table[key] for key in table if key in shared} for table in tables] for tables in corners]
    groups = corners if factor == METHOD else len(corners) * [[table for tables in corners for table in tables]]
    seeds = map(_whole_seeds, groups)
    corners = [[_of_seeds(table, whole) for table in tables] for tables, whole in zip(corners, seeds, strict=True)]
    sides = [balanced(_differences(before, after, quantity)) for before, after in corners]
    if not all(sides):
        return []
    if factor == METHOD:
        return [(1.0, np.array(list(sides[0].values()))), (-1.0, np.array(list(sides[1].values())))]
    seeds = [seed for seed in sides[0] if seed in sides[1]]
    return [(1.0, np.array([sides[0][seed] - sides[1][seed] for seed in seeds]))] if seeds else []


def _whole_seeds(tables: Sequence[Table]) -> set[int]:
    """Seeds that have every stratum in all of some tables: means over fewer strata are of other levels."""
    runs = [seeds.keys() for table in tables for seeds in table.values()]
    return set.intersection(*map(set, runs)) if runs else set()


def _of_seeds(table: Table, seeds: set[int]) -> Table:
    return {key: {seed: run for seed, run in runs.items() if seed in seeds} for key, runs in table.items()}


def _table(path: str, level: str, observations: Sequence[Observation], drop: str = "") -> Table:
    table: Table = {}
    for one in observations:
        if one.levels.get(path) == level:
            others = tuple(sorted((key, value) for key, value in one.levels.items() if key not in (path, drop)))
            table.setdefault((one.scene, others), {})[one.run.seed] = one
    return table


def _differences(before: Table, after: Table, quantity: MeasuredQuantity) -> dict[tuple[Any, ...], dict[int, float]]:
    """Stratum -> seed -> paired difference on shared views."""
    found: dict[tuple[Any, ...], dict[int, float]] = {}
    for key, runs in before.items():
        for seed, one in runs.items():
            other = after.get(key, {}).get(seed)
            if other is not None and (values := run_values((one.run, other.run), quantity)) is not None:
                found.setdefault(key, {})[seed] = values[1] - values[0]
    return found


def balanced(table: Mapping[Any, Mapping[int, float]]) -> dict[int, float]:
    """Seed -> mean over strata, since other factors add no independent seed, of the largest block of values without a hole.

    Where a seed lacks a stratum, as in unfinished studies, its mean over the others would be of another quantity than that of
    the next seed. So seeds or strata are left out, whichever loses fewer values; of equal blocks the one with more seeds stays.
    """
    sets = [frozenset(values) for values in table.values() if values]
    if not sets:
        return {}
    candidates = [*sets, frozenset.intersection(*sets)]
    kept = max(candidates, key=lambda seeds: (len(seeds) * sum(seeds <= own for own in sets), len(seeds)))
    strata = [values for values in table.values() if kept <= values.keys()]
    return {seed: sum(values[seed] for values in strata) / len(strata) for seed in sorted(kept)}


def _side(table: Table, other: Table, shared: Sequence[tuple[Any, ...]], quantity: MeasuredQuantity) -> Float[ndarray, " seed"]:
    """One value per seed of one side, averaged over the strata that both sides have; seeds that lack one are left out."""
    found: dict[int, list[float]] = {}
    strata = 0
    for key in shared:
        runs = [one.run for one in table[key].values()]
        values = run_values((*runs, *(one.run for one in other[key].values())), quantity)
        if values is not None:
            strata += 1
            for seed, value in zip(table[key], values, strict=False):
                found.setdefault(seed, []).append(value)
    return np.array([sum(values) / strata for values in found.values() if len(values) == strata])
