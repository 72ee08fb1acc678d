"""Differences at each combination of other factors' levels: whether a mean over them describes any of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.factors import Factor, FailedFit, Observation
from invgraphics.report.data.variants import setting_words
from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate
from invgraphics.report.statistics.pairing import Contrast, sample
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


def _settings_of(contrast: Contrast, observations: Sequence[Observation]) -> list[tuple[dict[str, str], list[Observation]]]:
    """Levels of all other factors, the method included, at which both sides of a contrast have runs, with these runs.

    Levels that all of them share are left out.

    Args:
        contrast: two levels of a factor, no interaction.
        observations: finished runs.
    """
    groups: dict[tuple[tuple[str, str], ...], list[Observation]] = {}
    for one in observations:
        fits = all(one.levels.get(key) == level for key, level in contrast.where.items())
        if fits and one.levels.get(contrast.factor) in contrast.levels:
            others = tuple(sorted((key, level) for key, level in one.levels.items() if key != contrast.factor))
            groups.setdefault(others, []).append(one)
    both = {key: runs for key, runs in groups.items() if len({run.levels[contrast.factor] for run in runs}) == 2}
    shared = set.intersection(*map(set, both)) if both else set()
    return [({key: level for key, level in levels if (key, level) not in shared}, both[levels]) for levels in sorted(both)]


def effects_by_setting(
    contrast: Contrast,
    quantity: MeasuredQuantity,
    observations: Sequence[Observation],
    lost: Sequence[FailedFit],
    factors: Sequence[Factor],
) -> dict[str, SettingEffect]:
    """A contrast at each combination of other factors' levels, in words, uncorrected; empty where there is one only."""

    def others(one: Observation | FailedFit) -> dict[str, str]:
        return {key: level for key, level in one.levels.items() if key != contrast.factor}

    settings = [] if contrast.against is not None else _settings_of(contrast, observations)
    found = {}
    for levels, runs in settings if 1 < len(settings) <= MOST_SETTINGS else []:
        own = sample(contrast, quantity, runs, [cell for cell in lost if others(cell) == others(runs[0])])
        if (value := own.whole) is not None:
            helped = flattered(quantity, value.mean, own.all_lost)
            found[setting_words(levels, factors)] = SettingEffect(value, own.across, flattered=helped)
    return found if len(found) > 1 else {}
