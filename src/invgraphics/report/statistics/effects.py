"""Effects of factor levels: paired differences with intervals, Holm-corrected over all comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.data.factors import METHOD, Factor, Observation
from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate, estimate, holm
from invgraphics.report.statistics.summary import value_of
from invgraphics.report.wording import Quantity, significant_decimals

ALPHA = 1 - CONFIDENCE
"""Family-wise error rate of a study."""


@dataclass(frozen=True)
class Effect:
    """A paired difference, level ``after`` minus level ``before``, same scene, seed, view and other factors.

    Attributes:
        factor: dotted path, or ``method``.
        before: level that is subtracted.
        after: level that it is subtracted from.
        quantity: what is compared.
        estimate: over all pairs, in stored units.
        adjusted: p-value after Holm's correction over the comparisons of this quantity; ``None`` without an interval.
        comparisons: size of that family.
        pairs: pairs of runs.
        by_scene: scene -> the same for that scene alone.
        by_method: method -> the same for that method alone; empty where the method is the factor or there is only one.
        truths_differ: some pairs were scored against different pictures, because the factor changes the truth.
    """

    factor: str
    before: str
    after: str
    quantity: Quantity
    estimate: Estimate
    adjusted: float | None
    comparisons: int
    pairs: int
    by_scene: dict[str, Estimate]
    by_method: dict[str, Estimate]
    truths_differ: bool

    @property
    def found(self) -> bool:
        """Whether the difference is significant after Holm's correction."""
        return self.adjusted is not None and self.adjusted <= ALPHA

    @property
    def uncorrected(self) -> bool:
        """Whether the difference is significant before correction only."""
        return not self.found and self.estimate.p is not None and self.estimate.p <= ALPHA

    @property
    def label(self) -> str:
        """The contrast of the two levels in words."""
        return contrast_words(self.factor, self.before, self.after)

    def text(self, value: float) -> str:
        """A difference with the digits of this effect, without its unit."""
        scale = self.quantity.scale
        size = max(abs(self.estimate.mean), self.estimate.half_width) * scale
        digits = significant_decimals(size) if self.quantity.decimals is None else self.quantity.decimals
        return f"{value * scale:,.{digits}f}".replace("-", "−")

    @property
    def interval(self) -> str:
        """The confidence interval as text; empty where there is none."""
        if self.estimate.unit == "none":
            return ""
        return f"[{self.text(self.estimate.low)}, {self.text(self.estimate.high)}]"

    @property
    def sentence(self) -> str:
        """The effect in a sentence: difference, interval, sample size and significance."""
        return _sentence(self)


def contrast_words(factor: str, before: str, after: str) -> str:
    """Contrast of two levels in words: ``data.train_views 20 instead of 40``."""
    return f"{after} instead of {before}" if factor == METHOD else f"{factor} {after} instead of {before}"


def effects_on(quantity: Quantity, factors: Sequence[Factor], observations: Sequence[Observation]) -> list[Effect]:
    """Paired effects of all compared levels on one quantity, corrected as one family (Holm 1979).

    Pairs of levels that no two runs share are left out.
    """
    found = []
    for factor in factors:
        for before, after in factor.pairs():
            effect = _effect(quantity, factor.path, (before, after), observations)
            if effect is not None:
                found.append(effect)
    adjusted = holm([effect.estimate.p for effect in found])
    family = sum(p is not None for p in adjusted)
    return [replace(effect, adjusted=p, comparisons=family) for effect, p in zip(found, adjusted, strict=True)]


Pair = tuple[Observation, Observation]


def matched_pairs(path: str, before: str, after: str, observations: Sequence[Observation]) -> list[Pair]:
    """Pairs of runs that differ in one factor only: same scene, same seed, same other levels."""
    sides: dict[str, dict[tuple[Any, ...], Observation]] = {before: {}, after: {}}
    for observation in observations:
        level = observation.levels.get(path)
        if level in sides:
            others = tuple(sorted((key, value) for key, value in observation.levels.items() if key != path))
            sides[level][(observation.scene, observation.run.seed, others)] = observation
    return [(one, sides[after][key]) for key, one in sides[before].items() if key in sides[after]]


def _effect(quantity: Quantity, path: str, levels: tuple[str, str], observations: Sequence[Observation]) -> Effect | None:
    pairs = matched_pairs(path, *levels, observations)
    differences = [(pair, found) for pair in pairs if (found := _difference(pair, quantity)) is not None]
    whole = estimate(_nest(differences))
    if whole is None:
        return None
    scenes = dict.fromkeys(pair[0].scene for pair, _ in differences)
    methods = dict.fromkeys(pair[0].levels.get(METHOD, "") for pair, _ in differences)
    by_scene = {scene: estimate(_nest([d for d in differences if d[0][0].scene == scene])) for scene in scenes}
    by_method = {name: estimate(_nest([d for d in differences if d[0][0].levels.get(METHOD) == name])) for name in methods}
    return Effect(
        factor=path,
        before=levels[0],
        after=levels[1],
        quantity=quantity,
        estimate=whole,
        adjusted=None,
        comparisons=0,
        pairs=len(differences),
        by_scene=_known(by_scene) if len(scenes) > 1 else {},
        by_method=_known(by_method) if path != METHOD and len(methods) > 1 else {},
        truths_differ=any(
            one.run.provenance.truth_sha256 != other.run.provenance.truth_sha256 for (one, other), _ in differences
        ),
    )


def _known(table: Mapping[str, Estimate | None]) -> dict[str, Estimate]:
    return {key: value for key, value in table.items() if value is not None}


def _difference(pair: Pair, quantity: Quantity) -> Float[ndarray, " view"] | None:
    """Paired differences, after minus before, on all shared views; one value where single views were not scored."""
    one, other = (observation.run for observation in pair)
    if quantity.group != "cost" and quantity.key in one.scores.quality and quantity.key in other.scores.quality:
        left, right = one.scores.quality[quantity.key].per_view, other.scores.quality[quantity.key].per_view
        if left and right:
            there = dict(zip(other.scores.views, _numbers(right), strict=True))
            shared = [
                (value, there[name]) for name, value in zip(one.scores.views, _numbers(left), strict=True) if name in there
            ]
            with np.errstate(invalid="ignore"):
                return np.array([b - a for a, b in shared])
    before, after = value_of(one, quantity), value_of(other, quantity)
    return None if before is None or after is None else np.array([after - before])


def _numbers(values: Sequence[float | None]) -> Float[ndarray, " view"]:
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def _nest(differences: Sequence[tuple[Pair, Float[ndarray, " view"]]]) -> list[list[ndarray]]:
    """Nest differences as scene -> seed -> view; other factors are averaged per view, since they add no independent seed."""
    cells: dict[str, dict[int, list[ndarray]]] = {}
    for (one, _), values in differences:
        cells.setdefault(one.scene, {}).setdefault(one.run.seed, []).append(values)
    return [[_average(values) for values in seeds.values()] for seeds in cells.values()]


def _average(values: Sequence[Float[ndarray, " view"]]) -> Float[ndarray, " view"]:
    """Mean over strata: view by view where all scored the same views, else of each stratum's mean."""
    if len({len(row) for row in values}) == 1:
        block = np.stack(values)
        present = np.isfinite(block)
        with np.errstate(invalid="ignore"):
            return np.where(present, block, 0.0).sum(axis=0) / np.where(present.any(axis=0), present.sum(axis=0), np.nan)
    means = [row[np.isfinite(row)].mean() for row in values if np.isfinite(row).any()]
    return np.array([np.mean(means)]) if means else np.full(1, np.nan)


def _verb(quantity: Quantity, difference: float) -> str:
    if quantity.better == "none":
        return "adds" if difference > 0 else "saves"
    return "gains" if (difference > 0) == (quantity.better == "higher") else "costs"


def _unit(quantity: Quantity) -> str:
    """Unit of a difference in words; the quantity's label where it has no unit."""
    if quantity.unit == "dB":
        return "dB"
    return f"{quantity.unit} of {quantity.label}" if quantity.unit else quantity.label


def _sentence(effect: Effect) -> str:
    value, unit = effect.estimate, _unit(effect.quantity)
    size = value.size
    note = (
        " The factor changes the truth itself, so the two were scored against different pictures."
        if effect.truths_differ
        else ""
    )
    magnitude = f"{_verb(effect.quantity, value.mean)} {effect.text(abs(value.mean))} {unit}"
    if value.unit == "none":
        return f"{effect.label} {magnitude} in the one seed there is, which gives no interval.{note}"
    if value.mean == 0 and value.half_width == 0:
        return f"{effect.label}: no difference at all, {size}.{note}"
    if not (effect.found or effect.uncorrected):
        return f"{effect.label}: no effect detectable above {effect.text(value.half_width)} {unit}, {size}.{note}"
    # The verb (gains, costs) carries the sign, so the interval's ends are magnitudes.
    low, high = sorted((abs(value.low), abs(value.high)))
    sentence = f"{effect.label} {magnitude} [{effect.text(low)}, {effect.text(high)}], {size}"
    if effect.found:
        return f"{sentence}.{note}"
    chance = f"with {effect.comparisons} comparisons in this study that may be chance (corrected p = {effect.adjusted:.2g})"
    return f"{sentence}; {chance}.{note}"
