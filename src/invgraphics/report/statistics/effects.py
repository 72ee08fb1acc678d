"""Effects of factor levels: differences with intervals over seeds and over scenes, corrected over all comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from invgraphics.report.data.factors import Factor, FailedFit, Observation
from invgraphics.report.statistics.clocks import disturbed_fits
from invgraphics.report.statistics.intervals import Estimate, holm
from invgraphics.report.statistics.pairing import Contrast, contrast_words, sample
from invgraphics.report.statistics.settings import ALPHA, SettingEffect, effects_by_setting, favoured, flattered
from invgraphics.report.wording import MeasuredQuantity, significant_decimals

Verdict = Literal["higher", "lower", "undecided", "untested"]
"""Of one scene: sign of a significant difference, none, or no test because there is a single fit."""


@dataclass(frozen=True)
class SceneEffect:
    """The same difference on one scene alone.

    Attributes:
        estimate: over new fits on this scene.
        adjusted: p-value after Holm's correction over all scenes and comparisons; ``None`` without one.
        flattered: the side that looks better lost more fits here than the other.
    """

    estimate: Estimate
    adjusted: float | None
    flattered: bool = False

    @property
    def verdict(self) -> Verdict:
        """Sign of the difference, where it is significant and the side that looks better lost no more fits there."""
        if self.adjusted is None:
            return "untested"
        if self.adjusted > ALPHA or self.flattered:
            return "undecided"
        return "higher" if self.estimate.mean > 0 else "lower"


@dataclass(frozen=True)
class Effect:
    """A difference, level ``after`` minus level ``before``, on the same scenes, views and other levels.

    Attributes:
        contrast: what is compared.
        quantity: in which.
        estimate: over new fits on these scenes, each counted equally, in stored units.
        across: over scenes as a sample of scenes; ``None`` for one scene.
        adjusted: p-value of `claim` after Holm's correction over the comparisons of this quantity; ``None`` without one.
        equivalence: p-value of the equivalence test of `claim` within the quantity's margin, corrected likewise; ``None``
            without a margin.
        comparisons: size of that family.
        pairs: fits compared.
        by_scene: scene -> the same for that scene alone; empty for one scene.
        by_setting: levels of all other factors in words -> the same at these alone; empty where there is one combination only.
        lost: diverged or failed fits that are (subtracted, added), see `Sample`.
        silent: scenes where one side has no number at all.
        truths_differ: some pairs were scored against different pictures, because the factor changes the truth.
        disturbed: fits whose times are left out, because their clocks were disturbed.
    """

    contrast: Contrast
    quantity: MeasuredQuantity
    estimate: Estimate
    across: Estimate | None
    adjusted: float | None
    comparisons: int
    pairs: int
    by_scene: Mapping[str, SceneEffect]
    by_setting: Mapping[str, SettingEffect]
    equivalence: float | None = None
    lost: tuple[int, int] = (0, 0)
    silent: tuple[str, ...] = ()
    truths_differ: bool = False
    disturbed: int = 0

    @property
    def claim(self) -> Estimate:
        """The estimate that a verdict rests on: over scenes where there are several, else over seeds."""
        return self.estimate if self.across is None else self.across

    @property
    def better(self) -> int:
        """1 where ``after`` is better, -1 where ``before`` is, 0 where neither direction is or there is no difference."""
        return favoured(self.quantity, self.claim.mean)

    @property
    def flattered(self) -> bool:
        """Whether the side that looks better lost more fits than the other: its mean is over those that went well."""
        return flattered(self.quantity, self.claim.mean, self.lost)

    @property
    def found(self) -> bool:
        """Whether the difference is significant after correction, not due to lost fits, and opposed by no scene or setting."""
        return self._sign != 0 and self._common

    @property
    def uncorrected(self) -> bool:
        """Whether the difference is significant before correction only."""
        return not self.found and self.claim.p is not None and self.claim.p <= ALPHA and self._common

    @property
    def equivalent(self) -> bool:
        """Whether the difference lies within the margin after correction, with no scene or setting that contradicts it.

        A scene whose own mean is outside the margin does: means of opposite signs cancel, and few fits find none of them.
        """
        if self.equivalence is None or self.equivalence > ALPHA or self.lost != (0, 0) or self.quantity.margin is None:
            return False
        margin = self.quantity.margin
        contradicted = any(one.verdict in ("higher", "lower") for one in self.by_scene.values())
        contradicted |= any(abs(one.estimate.mean) > margin for one in self.by_scene.values())
        return not contradicted and not any(one.sign for one in self.by_setting.values())

    @property
    def opposed(self) -> bool:
        """Whether the difference is significant with one sign at some levels of other factors, and with the other elsewhere."""
        return {1, -1} <= {self._sign, *(one.sign for one in self.by_setting.values())}

    @property
    def contradicted(self) -> bool:
        """Whether the difference is significant with one sign on some scenes, and with the other on others or over all."""
        signs: dict[Verdict, int] = {"higher": 1, "lower": -1}
        return {1, -1} <= {self._sign, *(signs.get(one.verdict, 0) for one in self.by_scene.values())}

    @property
    def _sign(self) -> int:
        """Sign of the mean where it is significant after correction; 0 for none."""
        significant = self.adjusted is not None and self.adjusted <= ALPHA
        return 0 if not significant else 1 if self.claim.mean > 0 else -1

    @property
    def _common(self) -> bool:
        """Whether a significant mean may be told as the direction of all: no fits are missing, no part says otherwise."""
        return not (self.flattered or self.opposed or self.contradicted)

    @property
    def detectable(self) -> float | None:
        """Effect that a repetition would find with 80 % power after correction, in stored units."""
        return self.claim.detectable(self.comparisons)

    def scenes(self, verdict: Verdict) -> list[str]:
        """Scenes with a verdict."""
        return [scene for scene, one in self.by_scene.items() if one.verdict == verdict]

    @property
    def factor(self) -> str:
        """The factor whose levels are compared."""
        return self.contrast.factor

    @property
    def before(self) -> str:
        """The level that is subtracted."""
        return self.contrast.before

    @property
    def after(self) -> str:
        """The level that it is subtracted from."""
        return self.contrast.after

    @property
    def label(self) -> str:
        """The contrast in words."""
        return self.contrast.label

    def text(self, value: float) -> str:
        """A difference with the digits of this effect, without its unit."""
        scale = self.quantity.scale
        size = max(abs(self.estimate.mean), self.estimate.half_width) * scale
        digits = significant_decimals(size) if self.quantity.decimals is None else self.quantity.decimals
        return f"{value * scale:z,.{digits}f}".replace("-", "−")

    def bounds(self, value: Estimate | None) -> str:
        """A confidence interval as text; empty where there is none."""
        return "" if value is None or value.unit == "none" else f"[{self.text(value.low)}, {self.text(value.high)}]"

    @property
    def interval(self) -> str:
        """The interval for new fits on these scenes as text; empty where there is none."""
        return self.bounds(self.estimate)

    @property
    def across_interval(self) -> str:
        """The interval for other scenes like these as text; empty where there is none."""
        return self.bounds(self.across)


def contrasts_of(
    factors: Sequence[Factor], each: str = "", interactions: Sequence[Sequence[str]] = (), among: Sequence[str] = ()
) -> list[Contrast]:
    """The comparisons of a study: interactions that it asks about first, then pairs of levels.

    Args:
        factors: of the study.
        each: factor whose levels are answered one by one, for questions that say "each"; empty for the mean over them.
        interactions: pairs of factors whose interaction is the question: of the outermost levels of both.
        among: levels of ``each``.
    """
    by_path = {factor.path: factor for factor in factors}
    found = [
        _interaction(one, two)
        for first, second in interactions
        if (one := by_path.get(first)) is not None and (two := by_path.get(second)) is not None
    ]
    for factor in factors:
        found += [
            Contrast(factor.path, before, after, where=where, name=factor.named(before, after))
            for where in places_of(factor, each, among)
            for before, after in factor.pairs()
        ]
    return found


def places_of(factor: Factor, each: str, among: Sequence[str]) -> list[dict[str, str]]:
    """Levels of ``each`` at which a factor's effect is estimated; one empty level for all of them together."""
    return [{each: level} for level in among] if each and factor.path != each else [{}]


def _interaction(one: Factor, two: Factor) -> Contrast:
    """How the difference between the outermost levels of one factor differs between those of another."""
    before, after, low, high = one.levels[0], one.levels[-1], two.levels[0], two.levels[-1]
    difference = one.named(before, after) or contrast_words(one.path, before, after)
    name = f"{difference}, at {two.word(high)} rather than {two.words.get(low, low)}"
    return Contrast(one.path, before, after, against=(two.path, low, high), name=name)


def effects_of(
    contrasts: Sequence[Contrast],
    quantity: MeasuredQuantity,
    observations: Sequence[Observation],
    lost: Iterable[FailedFit] = (),
    factors: Sequence[Factor] = (),
) -> list[Effect]:
    """Effects of given contrasts on one quantity, corrected as one family (Holm 1979).

    Those that no two runs share are left out, and of times the fits whose clocks were disturbed.

    Args:
        contrasts: what is compared.
        quantity: in which.
        observations: finished runs.
        lost: fits that failed.
        factors: of the study, whose words name the levels of other factors.
    """
    failed, disturbed = tuple(lost), disturbed_fits(observations, quantity)
    left_out = set(map(id, disturbed))
    observations = [one for one in observations if id(one) not in left_out]
    found = [
        effect for contrast in contrasts if (effect := _effect(contrast, quantity, (observations, failed), factors)) is not None
    ]
    adjusted = holm([effect.claim.p for effect in found])
    margin = quantity.margin
    same = holm([None if margin is None else effect.claim.equivalence(margin) for effect in found])
    scenes = iter(holm([one.estimate.p for effect in found for one in effect.by_scene.values()]))
    settings = iter(holm([one.claim.p for effect in found for one in effect.by_setting.values()]))
    family = sum(p is not None for p in adjusted)
    return [
        replace(
            effect,
            adjusted=p,
            equivalence=within,
            comparisons=family,
            disturbed=sum(map(effect.contrast.takes, disturbed)),
            by_scene={scene: replace(one, adjusted=next(scenes)) for scene, one in effect.by_scene.items()},
            by_setting={name: replace(one, adjusted=next(settings)) for name, one in effect.by_setting.items()},
        )
        for effect, p, within in zip(found, adjusted, same, strict=True)
    ]


def _effect(
    contrast: Contrast,
    quantity: MeasuredQuantity,
    observed: tuple[Sequence[Observation], Sequence[FailedFit]],
    factors: Sequence[Factor],
) -> Effect | None:
    values = sample(contrast, quantity, *observed)
    if (whole := values.whole) is None:
        return None
    return Effect(
        contrast=contrast,
        quantity=quantity,
        estimate=whole,
        across=values.across,
        adjusted=None,
        comparisons=0,
        pairs=values.pairs,
        by_scene={
            scene: SceneEffect(one, None, flattered(quantity, one.mean, values.lost.get(scene, (0, 0))))
            for scene, one in values.alone.items()
        },
        by_setting=effects_by_setting(contrast, quantity, *observed, factors),
        lost=values.all_lost,
        silent=values.silent,
        truths_differ=values.truths_differ,
    )
