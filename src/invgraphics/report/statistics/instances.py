"""Statistics of inferred instances of a class: instances are the sample, their test views are averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate, estimate, holm
from invgraphics.report.statistics.values import PERFECT_DB
from invgraphics.runs.inference import Inference, InstanceScores

LESS_IS_BETTER = frozenset({"normal_deg", "depth_abs_rel"})
"""Metrics that are errors; of all others more is better."""


@dataclass(frozen=True)
class Cell:
    """Mean of a metric over instances, and its difference from the reference on the same test views.

    Attributes:
        mean: over test views, then over instances; ``None`` where there is none.
        gain: paired difference from the reference; ``None`` for the reference itself, and without common instances.
        certain: whether the difference stays beyond chance when corrected for all of its table (Holm), and the better side
            lacks no instance of the other's.
        lost: instances of which this side lacks scores that the reference has, and the reference those that it has.
    """

    mean: float | None
    gain: Estimate | None
    certain: bool = False
    lost: tuple[int, int] = (0, 0)


def counts_of(record: Inference) -> list[int]:
    """Numbers of observed views, rising."""
    return sorted({one.observed for one in record.instances})


def methods_of(record: Inference) -> list[str]:
    """Names of the inference methods: the priors, then the baselines."""
    return list(dict.fromkeys([*record.runs, *(one.how for one in record.instances)]))


def subjects_of(record: Inference, observed: int) -> list[int]:
    """Instances that were inferred from so many views."""
    return sorted({one.subject for one in record.instances if one.observed == observed})


def scores_of(record: Inference, observed: int, method: str) -> list[InstanceScores]:
    """Scores of all instances that one method inferred from so many views."""
    return [one for one in record.instances if one.how == method and one.observed == observed]


def mean_of(record: Inference, metric: str, observed: int, method: str) -> Estimate | None:
    """Mean of a metric over the test views of each instance, then over instances, with its 95 % interval."""
    return estimate([[values] for values in _of_subjects(record, metric, observed, method).values()], over="scenes")


def paired(record: Inference, metric: str, observed: int, pair: tuple[str, str]) -> Estimate | None:
    """Mean difference of a metric between two methods on the same test views; instances are the sample."""
    return estimate([[first - second] for first, second in _pairs(record, metric, observed, pair)], over="scenes")


def lost(record: Inference, metric: str, observed: int, pair: tuple[str, str]) -> tuple[int, int]:
    """Numbers of instances of which the first of two methods, and the second, lacks a view's score that the other one has."""
    known = [(np.isfinite(first), np.isfinite(second)) for first, second in _pairs(record, metric, observed, pair)]
    return sum(bool((~a & b).any()) for a, b in known), sum(bool((a & ~b).any()) for a, b in known)


def lacking(record: Inference, metric: str, observed: int, method: str) -> int:
    """Number of instances of which a method lacks a view's score that some other method has."""
    counts = dict.fromkeys(subjects_of(record, observed), False)
    for other in methods_of(record):
        pairs = _pairs(record, metric, observed, (method, other))
        for subject, (own, theirs) in zip(counts, pairs, strict=True):
            counts[subject] |= bool((~np.isfinite(own) & np.isfinite(theirs)).any())
    return sum(counts.values())


def flattered(metric: str, gain: Estimate, lacks: tuple[int, int]) -> bool:
    """Whether the better side of a difference lacks instances of the other's: hard ones, perhaps, that it could not show."""
    better = 0 if (gain.mean > 0) != (metric in LESS_IS_BETTER) else 1
    return lacks[better] > 0


def table_of(record: Inference, metric: str, methods: Sequence[str]) -> dict[str, dict[int, Cell]]:
    """Method -> number of views -> mean and difference from the first of ``methods``, one family of tests."""
    counts, first = counts_of(record), methods[0]
    gains = {(name, n): None if name == first else paired(record, metric, n, (name, first)) for name in methods for n in counts}
    adjusted = dict(zip(gains, holm([None if gain is None else gain.p for gain in gains.values()]), strict=True))
    table: dict[str, dict[int, Cell]] = {name: {} for name in methods}
    for (name, n), gain in gains.items():
        mean, p = mean_of(record, metric, n, name), adjusted[name, n]
        lacks = lost(record, metric, n, (name, first))
        certain = gain is not None and p is not None and p < 1 - CONFIDENCE and not flattered(metric, gain, lacks)
        table[name][n] = Cell(None if mean is None else mean.mean, gain, certain, lacks)
    return table


Pair = tuple[Float[ndarray, " view"], Float[ndarray, " view"]]
"""Scores of an instance's test views by two methods; NaN where one has none."""


def _pairs(record: Inference, metric: str, observed: int, pair: tuple[str, str]) -> list[Pair]:
    """Scores by two methods of each instance that was inferred from so many views."""
    first, second = (_of_subjects(record, metric, observed, method) for method in pair)
    none = np.empty(0)
    found = [(first.get(subject, none), second.get(subject, none)) for subject in subjects_of(record, observed)]
    return [(_padded(a, len(b)), _padded(b, len(a))) for a, b in found]


def _of_subjects(record: Inference, metric: str, observed: int, method: str) -> dict[int, Float[ndarray, " view"]]:
    return {one.subject: _values(one, metric) for one in scores_of(record, observed, method)}


def _values(scores: InstanceScores, metric: str) -> Float[ndarray, " view"]:
    """A metric of each test view, NaN where there is none; a PSNR of equal pictures is that of perfect ones."""
    values = np.array([np.nan if value is None else value for value in scores.quality.get(metric, ())], dtype=float)
    return np.minimum(values, PERFECT_DB) if metric == "psnr" else values


def _padded(values: Float[ndarray, " view"], views: int) -> Float[ndarray, " view"]:
    """Scores of at least so many views: a method that has none of a metric lacks them all."""
    return np.concatenate([values, np.full(max(0, views - len(values)), np.nan)])
