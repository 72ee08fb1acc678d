"""Differences at each combination of other factors' levels: whether a mean over them describes any of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.factors import Factor, Lost, Observation
from invgraphics.report.data.variants import setting_words
from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate, over_scenes, over_seeds
from invgraphics.report.statistics.pairing import Contrast, Sample, sample, settings_of
from invgraphics.report.wording import MeasuredQuantity

ALPHA = 1 - CONFIDENCE
"""Family-wise error rate of a study."""
MOST_SETTINGS = 100
"""Combinations of other factors' levels in which an effect is examined one by one; of more there are too few fits in each."""


@dataclass(frozen=True)
class SettingEffect:
    """The same difference where every other factor, the method included, has one level.

    Attributes:
        estimate: over new fits on these scenes.
        across: over scenes as a sample of scenes; ``None`` for one scene.
        adjusted: p-value of `claim` after Holm's correction over all settings and comparisons; ``None`` without one.
        flattered: the side that looks better lost more fits here than the other.
    """

    estimate: Estimate
    across: Estimate | None
    adjusted: float | None = None
    flattered: bool = False

    @property
    def claim(self) -> Estimate:
        """The estimate that a test rests on: over scenes where there are several, else over seeds."""
        return self.estimate if self.across is None else self.across

    @property
    def sign(self) -> int:
        """Sign of a significant difference; 0 for none, and where lost fits may have made it."""
        if self.adjusted is None or self.adjusted > ALPHA or self.flattered:
            return 0
        return 1 if self.claim.mean > 0 else -1


def across_scenes(values: Sample, whole: Estimate) -> Estimate | None:
    """Estimate over scenes as a sample of scenes; ``None`` for one scene. ``whole`` is that over new fits on these."""
    groups = list(values.scenes.values())
    return over_scenes(groups, least_error=whole.error) if len(groups) > 1 else None


def favoured(quantity: MeasuredQuantity, mean: float) -> int:
    """Which side a mean difference favours: 1 for the one that is added, -1 for the one that is subtracted, 0 for neither."""
    if quantity.better == "none" or mean == 0:
        return 0
    return 1 if (mean > 0) == (quantity.better == "higher") else -1


def flattered(quantity: MeasuredQuantity, mean: float, lost: tuple[int, int]) -> bool:
    """Whether the side that looks better lost more fits, of (subtracted, added): its mean is over those that went well."""
    subtracted, added = lost
    side = favoured(quantity, mean)
    return (side > 0 and added > subtracted) or (side < 0 and subtracted > added)


def effects_by_setting(
    contrast: Contrast,
    quantity: MeasuredQuantity,
    observations: Sequence[Observation],
    lost: Sequence[Lost],
    factors: Sequence[Factor],
) -> dict[str, SettingEffect]:
    """A contrast at each combination of other factors' levels, in words, uncorrected; empty where there is one only."""

    def others(one: Observation | Lost) -> dict[str, str]:
        return {key: level for key, level in one.levels.items() if key != contrast.factor}

    settings = [] if contrast.against is not None else settings_of(contrast, observations)
    found = {}
    for levels, runs in settings if 1 < len(settings) <= MOST_SETTINGS else []:
        own = sample(contrast, quantity, runs, [cell for cell in lost if others(cell) == others(runs[0])])
        if (value := over_seeds(list(own.scenes.values()))) is not None:
            helped = flattered(quantity, value.mean, own.all_lost)
            found[setting_words(levels, factors)] = SettingEffect(value, across_scenes(own, value), flattered=helped)
    return found if len(found) > 1 else {}
