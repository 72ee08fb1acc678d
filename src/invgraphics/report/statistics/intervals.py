"""Confidence intervals, tests, detectable effects and equivalence for scores of fits on scenes.

Views of one fit share its weights, so they are averaged and never units. There are two estimands, neither replaces the other:

- over *seeds*, on these scenes: scenes are fixed and count equally; the interval holds for new fits on the same scenes.
  Student's t, with Welch's degrees of freedom over several scenes or over two independent groups of seeds.
- over *scenes*, as a sample of scenes: the scene is the unit, its mean over seeds the value; the interval holds for scenes that
  are like these as these are like each other. Student's t over scenes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

CONFIDENCE = 0.95
POWER = 0.8
"""Probability with which a detectable effect is found."""
ROUNDING = 1e-12
"""Spread, relative to the scores, below which values count as equal: a thousand times the rounding of a difference."""
NODES = 96
"""Quantiles of the estimated spread over which power is averaged."""

Nested = Sequence[Sequence[Float[ndarray, " view"]]]
"""Scene -> seed -> one value per view; lengths may differ, values that are not finite are left out."""

Groups = Sequence[tuple[float, Float[ndarray, " fit"]]]
"""(sign, one value per fit) of each independent group of fits on a scene: the signed sum of their means is estimated."""

Unit = Literal["none", "seed", "scene"]


@dataclass(frozen=True)
class Estimate:
    """A mean with its confidence interval, p-value and sample size.

    Attributes:
        mean: over views, then seeds, then scenes, each step with equal weights.
        low: lower end of the interval; equal to the mean where there is none.
        high: its upper end.
        p: two-sided p-value of a true mean of zero, dual to the interval; ``None`` without an interval.
        unit: what the interval treats as independent; ``none`` where no spread is known: a single unit, or units that agree to
            the last digit, whose spread is not zero but unknown.
        scenes: number of scenes.
        seeds: (fewest, most) seeds per scene.
        error: standard error of the mean; 0 where no spread is known.
        freedom: its degrees of freedom; 0 likewise.
    """

    mean: float
    low: float
    high: float
    p: float | None
    unit: Unit
    scenes: int
    seeds: tuple[int, int]
    error: float = 0.0
    freedom: float = 0.0

    @property
    def half_width(self) -> float:
        """Half of the interval's width."""
        return (self.high - self.low) / 2

    @property
    def size(self) -> str:
        """Sample size in words, for instance ``3 seeds × 2 scenes``."""
        fewest, most = self.seeds
        count = str(most) if fewest == most else f"{fewest} to {most}"
        scenes = f" × {self.scenes} scenes" if self.scenes > 1 else ""
        return f"{count} {'seed' if most == 1 else 'seeds'}{scenes}"

    def detectable(self, comparisons: int = 1, power: float = POWER) -> float | None:
        """Effect that a repetition of this design finds with probability ``power``, corrected for ``comparisons`` tests.

        Bonferroni's level, which is Holm's for the first of them. The spread is estimated from few fits, so power is averaged
        over what the estimate may be (assurance; O'Hagan, Stevens & Campbell 2005) rather than computed as if it were known.
        ``None`` where no spread is known.
        """
        if self.p is None:
            return None
        return self.error * _detectable_errors(round(self.freedom, 2), (1 - CONFIDENCE) / max(1, comparisons), power)

    def equivalence(self, margin: float) -> float | None:
        """p-value of two one-sided tests (Schuirmann 1987) of a mean within ±``margin``; ``None`` where no spread is known."""
        if self.p is None:
            return None
        from scipy.special import stdtr

        return float(stdtr(self.freedom, -(margin - abs(self.mean)) / self.error))


def estimate(nested: Nested, over: Literal["seeds", "scenes"] = "seeds", confidence: float = CONFIDENCE) -> Estimate | None:
    """Mean, confidence interval and p-value of nested scores, or of paired differences of them.

    Args:
        nested: scene -> seed -> values per view.
        over: what is drawn at random: new fits on these scenes, or scenes.
        confidence: probability that the interval covers the true mean, in (0, 1).

    Returns:
        The estimate; ``None`` where no value is finite.
    """
    fits = [np.array([row[np.isfinite(row)].mean() for row in scene if np.isfinite(row).any()]) for scene in nested]
    groups = [[(1.0, values)] for values in fits if len(values)]
    return over_scenes(groups, confidence) if over == "scenes" else over_seeds(groups, confidence)


def over_seeds(scenes: Sequence[Groups], confidence: float = CONFIDENCE, scores: float = 0.0) -> Estimate | None:
    """Mean over these scenes, with the interval for new fits on them; ``None`` without scenes.

    The mean of scene means has variance Σ s²ₖ/nₖ / S² over all groups of fits, with Welch's (1947) degrees of freedom. Where a
    group is a single fit, the groups in its place on all scenes use the variance pooled over them; of the other side, a method
    whose fits may scatter differently, nothing is borrowed, and without spread on each side there is no interval.

    Args:
        scenes: groups of fits of each.
        confidence: of the interval.
        scores: largest magnitude of the scores that the values are differences of: what its rounding makes is no spread.
    """
    if not scenes:
        return None
    parts = [values for groups in scenes for _, values in groups]
    mean = float(np.mean([_signed_mean(groups) for groups in scenes]))
    size = len(scenes), _seeds(scenes)
    scale = max(scores, *(float(np.abs(values).max()) for values in parts))
    sides = [_shares([values for _, values in side]) for side in zip(*scenes, strict=True)]
    shares = np.array([share for side in sides for share in side])
    if not all(sides) or sum(((values - values.mean()) ** 2).sum() for values in parts) <= (ROUNDING * scale) ** 2:
        return Estimate(mean, mean, mean, None, "none", *size)
    variances, freedom = shares[shares[:, 0] > 0].T
    satterthwaite = float(variances.sum() ** 2 / (variances**2 / freedom).sum())
    return _student_estimate(mean, (math.sqrt(variances.sum()) / len(scenes), satterthwaite), "seed", size, confidence)


def _shares(side: Sequence[Float[ndarray, " fit"]]) -> list[tuple[float, int]]:
    """(variance of the mean, degrees of freedom) of a side's groups; pooled where one is a single fit, empty if all are."""
    counts = np.array([len(values) for values in side])
    sums, freedom = np.array([((values - values.mean()) ** 2).sum() for values in side]), counts - 1
    if (freedom > 0).all():
        return [(float(share), int(free)) for share, free in zip(sums / freedom / counts, freedom, strict=True)]
    total = int(freedom.sum())
    return [(float(sums.sum() / total * (1 / counts).sum()), total)] if total else []


def over_scenes(
    scenes: Sequence[Groups], confidence: float = CONFIDENCE, least_error: float = 0.0, scores: float = 0.0
) -> Estimate | None:
    """Mean over scenes as a sample of scenes, with the interval for scenes like these; ``None`` without scenes.

    Args:
        scenes: groups of fits of each.
        confidence: of the interval.
        least_error: standard error that the fits' own spread makes; scenes that agree better than that do so by chance.
        scores: as in `over_seeds`.
    """
    if not scenes:
        return None
    means = np.array([_signed_mean(groups) for groups in scenes])
    mean, size = float(means.mean()), (len(scenes), _seeds(scenes))
    spread = float(means.std(ddof=1)) if len(means) > 1 else 0.0
    if spread <= ROUNDING * max(scores, float(np.abs(means).max())):
        return Estimate(mean, mean, mean, None, "none", *size)
    error = max(spread / math.sqrt(len(means)), least_error)
    return _student_estimate(mean, (error, len(means) - 1.0), "scene", size, confidence)


def _signed_mean(groups: Groups) -> float:
    return float(sum(sign * values.mean() for sign, values in groups))


def _seeds(scenes: Sequence[Groups]) -> tuple[int, int]:
    counts = [len(values) for groups in scenes for _, values in groups]
    return min(counts), max(counts)


def _student_estimate(
    mean: float, spread: tuple[float, float], unit: Unit, size: tuple[int, tuple[int, int]], confidence: float
) -> Estimate:
    error, freedom = spread
    critical, p = _student(abs(mean) / error, freedom, confidence)
    return Estimate(mean, mean - critical * error, mean + critical * error, p, unit, *size, error, freedom)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's step-down adjusted p-values of one family; entries without a p-value stay ``None`` and do not count.

    Written out because statsmodels' ``multipletests``, which the tests compare it with, collects garbage at every call: half of
    the time of a study's page.
    """
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    highest = 0.0
    for rank, (p, index) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        adjusted[index] = highest
    return adjusted


def mean_half_width(deviation: float, count: int, confidence: float = CONFIDENCE) -> float:
    """Half of the t-interval of a mean of ``count`` > 1 independent values with sample standard deviation ``deviation``."""
    return _student(0.0, count - 1, confidence)[0] * deviation / math.sqrt(count)


def band(values: Float[ndarray, "seed time"], confidence: float = CONFIDENCE) -> tuple[ndarray, ndarray, ndarray]:
    """Mean over seeds with a t-interval at each time: (mean, low, high); for a single seed all three are equal."""
    mean, count = values.mean(axis=0), len(values)
    if count < 2:
        return mean, mean, mean
    half = mean_half_width(1.0, count, confidence) * values.std(axis=0, ddof=1)
    return mean, mean - half, mean + half


def _student(statistic: float, freedom: float, confidence: float) -> tuple[float, float]:
    """(critical value, two-sided p) of Student's t."""
    from scipy.special import stdtr, stdtrit

    return float(stdtrit(freedom, (1 + confidence) / 2)), float(2 * stdtr(freedom, -statistic))


@functools.lru_cache(maxsize=4096)
def _detectable_errors(freedom: float, level: float, power: float) -> float:
    """True effect, in estimated standard errors, that a two-sided t-test of ``level`` finds with probability ``power``.

    The test finds it where z + r x > c q: z is normal, q and r are the estimated over the true standard error, of the
    repetition and of this study, and c is the critical value. The normal tail is averaged over quantiles of both, since SciPy's
    non-central t fails at the shifts of thousands that one degree of freedom needs.
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri, ndtr, stdtrit

    critical = -float(stdtrit(freedom, level / 2))
    ratios = np.sqrt(chdtri(freedom, 1 - (np.arange(NODES) + 0.5) / NODES) / freedom)

    def missed(log_errors: float) -> float:
        return float(ndtr(critical * ratios[:, None] - math.exp(log_errors) * ratios).mean()) - (1 - power)

    low, high = math.log(critical) - 1, math.log(critical) + 1
    while missed(low) < 0:
        low -= 1
    while missed(high) > 0:
        high += 1
    root = brentq(missed, low, high, xtol=1e-3)
    return math.exp(root)  # pyright: ignore[reportArgumentType]  # a tuple only with full_output
