"""Confidence intervals and tests for hierarchical scores: views within a seed, seeds within a scene.

Views of one fit share its weights, so they are never units. The unit is the seed (a fit), or the scene:

- ten scenes or more: the scene; hierarchical bootstrap scene > seed > view. The interval generalises to scenes like these.
- one seed on each of several scenes: the scene; a t-interval over scenes.
- otherwise: the seed within its scene, scenes counted equally and held fixed. It generalises to new fits on these scenes.
  Below ten seeds a Welch t-interval; from ten seeds on a hierarchical bootstrap seed > view inside each scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

ENOUGH = 10
"""Units from which on resampling replaces the t distribution; fewer carry too little of a distribution's shape."""

RESAMPLES = 1999
"""Bootstrap resamples; with the observed one they make steps of 1/2000 in p."""

BATCH = 1_500_000
"""Scores drawn at a time, which bounds the memory of resampling."""

CONFIDENCE = 0.95

Nested = Sequence[Sequence[Float[ndarray, " view"]]]
"""Scene -> seed -> one value per view; lengths may differ, values that are not finite are left out."""

Unit = Literal["none", "seed", "scene"]


@dataclass(frozen=True)
class Estimate:
    """A mean with its confidence interval, p-value and sample size.

    Attributes:
        mean: over views, then seeds, then scenes, each step with equal weights.
        low: lower end of the interval; equal to the mean where there is none.
        high: its upper end.
        p: two-sided p-value of a true mean of zero, dual to the interval; ``None`` without an interval.
        unit: what the interval counts as independent; ``none`` for a single fit, which has no interval.
        resampled: whether the interval is a hierarchical bootstrap rather than a t-interval.
        scenes: number of scenes.
        seeds: (fewest, most) seeds per scene.
    """

    mean: float
    low: float
    high: float
    p: float | None
    unit: Unit
    resampled: bool
    scenes: int
    seeds: tuple[int, int]

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


@dataclass(frozen=True)
class _Design:
    """Finite scores of a hierarchical design, padded to a dense array.

    Attributes:
        values: scores, NaN where a scene has fewer seeds or a seed fewer views.
        seeds: seeds of each scene.
        views: views of each seed, 0 where there is no such seed.
        by_scene: whether scenes are the units.
    """

    values: Float[ndarray, "scene seed view"]
    seeds: Int[ndarray, " scene"]
    views: Int[ndarray, "scene seed"]
    by_scene: bool


def estimate(nested: Nested, confidence: float = CONFIDENCE, seed: int = 0) -> Estimate | None:
    """Mean, confidence interval and p-value of nested scores or of paired differences of them.

    Args:
        nested: scene -> seed -> values per view.
        confidence: probability that the interval covers the true mean, in (0, 1).
        seed: of the resampling.

    Returns:
        The estimate; ``None`` where no value is finite.
    """
    design = _arrange(nested)
    if design is None:
        return None
    fits = _mean_of_views(design.values)
    mean, error, freedom = (float(item) for item in _standard_error(fits, design.seeds, design.by_scene))
    size = (len(design.seeds), (int(design.seeds.min()), int(design.seeds.max())))
    if size[0] == 1 and size[1][1] == 1:
        return Estimate(mean, mean, mean, None, "none", False, *size)
    unit: Unit = "scene" if design.by_scene else "seed"
    units = size[0] if design.by_scene else size[1][0]
    resampled = units >= ENOUGH
    scale = float(np.nanmax(np.abs(fits)))
    if error <= 1e-12 * scale:  # seeds change nothing: the mean is exact
        return Estimate(mean, mean, mean, 1.0 if abs(mean) <= 1e-12 * scale else 0.0, unit, resampled, *size)
    if resampled:
        critical, p = _bootstrap(design, mean, abs(mean) / error, confidence, seed)
    else:
        critical, p = _student(abs(mean) / error, freedom, confidence)
    return Estimate(mean, mean - critical * error, mean + critical * error, p, unit, resampled, *size)


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


def _arrange(nested: Nested) -> _Design | None:
    """Drop non-finite scores and pad the rest to a dense array; ``None`` where no score is finite."""
    kept = [[finite for values in scene if len(finite := values[np.isfinite(values)])] for scene in nested]
    kept = [scene for scene in kept if scene]
    if not kept:
        return None
    seeds = np.array([len(scene) for scene in kept])
    views = np.zeros((len(kept), int(seeds.max())), int)
    block = np.full((*views.shape, max(len(values) for scene in kept for values in scene)), np.nan)
    for s, scene in enumerate(kept):
        for k, values in enumerate(scene):
            views[s, k] = len(values)
            block[s, k, : len(values)] = values
    return _Design(block, seeds, views, len(kept) >= ENOUGH or (len(kept) > 1 and seeds.max() == 1))


def _mean_of_views(values: Float[ndarray, "*b view"]) -> Float[ndarray, "*b"]:
    """Mean over views that exist; NaN where none does."""
    present = np.isfinite(values)
    count = present.sum(axis=-1)
    return np.where(count > 0, np.where(present, values, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _standard_error(
    fits: Float[ndarray, "*b scene seed"], seeds: Int[ndarray, "*b scene"], by_scene: bool
) -> tuple[Float[ndarray, "*b"], Float[ndarray, "*b"], Float[ndarray, "*b"]]:
    """(mean, its standard error, degrees of freedom) from one value per fit; NaN where a scene lacks a seed.

    With the seed as unit, the mean of scene means has variance Σ s²ᵢ/nᵢ / S² with Welch's (1947) degrees of freedom. Where a
    scene has a single seed, all use the variance pooled over scenes.
    """
    present = np.isfinite(fits)
    scene_means = np.where(present, fits, 0.0).sum(axis=-1) / seeds
    scenes = fits.shape[-2]
    mean = scene_means.mean(axis=-1)
    if by_scene:
        spread = scene_means.std(axis=-1, ddof=1)
        return mean, spread / math.sqrt(scenes), np.full_like(mean, scenes - 1)
    squares = np.where(present, fits - scene_means[..., None], 0.0) ** 2
    sums, freedom = squares.sum(axis=-1), seeds - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        if (seeds > 1).all():
            parts = sums / freedom / seeds
            satterthwaite = parts.sum(axis=-1) ** 2 / (parts**2 / freedom).sum(axis=-1)
        else:
            parts = (sums.sum(axis=-1) / freedom.sum(axis=-1))[..., None] / seeds
            satterthwaite = freedom.sum(axis=-1).astype(float)
    return mean, np.sqrt(parts.sum(axis=-1)) / scenes, satterthwaite


def _student(statistic: float, freedom: float, confidence: float) -> tuple[float, float]:
    """(critical value, two-sided p) of Student's t."""
    from scipy.special import stdtr, stdtrit

    return float(stdtrit(freedom, (1 + confidence) / 2)), float(2 * stdtr(freedom, -statistic))


def _bootstrap(design: _Design, mean: float, statistic: float, confidence: float, seed: int) -> tuple[float, float]:
    """(critical value, p) of the symmetric bootstrap-t (Hall 1992, §3.5), units > seeds > views drawn with replacement.

    Studentising each resample keeps the error rate near its nominal value at ten units, where percentiles are too narrow.
    """
    generator = np.random.default_rng(seed)
    batch = max(1, BATCH // design.values.size)
    draws = []
    for start in range(0, RESAMPLES, batch):
        fits, seeds = _resample(design, min(batch, RESAMPLES - start), generator)
        means, errors, _ = _standard_error(fits, seeds, design.by_scene)
        with np.errstate(divide="ignore", invalid="ignore"):
            draws.append(np.nan_to_num(np.abs(means - mean) / errors, nan=0.0))
    statistics = np.concatenate(draws)
    p = (1 + int((statistics >= statistic).sum())) / (1 + RESAMPLES)
    # The same rank rule as p, so that the interval holds zero exactly where p exceeds 1 - confidence.
    rank = RESAMPLES - math.floor((1 - confidence) * (1 + RESAMPLES) + 1e-9)
    return float(np.sort(statistics)[rank]), p


def _resample(
    design: _Design, count: int, generator: np.random.Generator
) -> tuple[Float[ndarray, "b scene seed"], Int[ndarray, "b scene"]]:
    """``count`` hierarchical bootstrap samples (scenes where they are units > seeds > views), averaged over views per fit."""
    scenes, most_seeds, most_views = design.values.shape
    if design.by_scene:
        scene = generator.integers(scenes, size=(count, scenes))
    else:
        scene = np.broadcast_to(np.arange(scenes), (count, scenes))
    seeds = design.seeds[scene]
    place = scene[..., None]
    seed = (generator.random((count, scenes, most_seeds)) * seeds[..., None]).astype(int)
    views = design.views[place, seed]
    view = (generator.random((count, scenes, most_seeds, most_views), np.float32) * views[..., None]).astype(int)
    view = np.minimum(view, views[..., None] - 1)  # float32 can round up to the number of views
    drawn = design.values[place[..., None], seed[..., None], view]
    drawn[np.arange(most_views) >= views[..., None]] = np.nan
    fits = _mean_of_views(drawn)
    fits[np.arange(most_seeds) >= seeds[..., None]] = np.nan
    return fits, seeds
