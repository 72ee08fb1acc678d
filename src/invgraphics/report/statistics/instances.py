"""Statistics of inferred instances of a class: instances are the sample, their test views are averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate, estimate, holm
from invgraphics.runs.inference import Inference, InstanceScores


@dataclass(frozen=True)
class Cell:
    """Mean of a metric over instances, and its difference from the reference on the same test views.

    Attributes:
        mean: over test views, then over instances; ``None`` where there is none.
        gain: paired difference from the reference; ``None`` for the reference itself, and without common instances.
        certain: whether the difference stays beyond chance when corrected for all of its table (Holm).
    """

    mean: float | None
    gain: Estimate | None
    certain: bool = False


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
    return estimate([[_values(one, metric)] for one in scores_of(record, observed, method)], over="scenes")


def paired(record: Inference, metric: str, observed: int, pair: tuple[str, str]) -> Estimate | None:
    """Mean difference of a metric between two methods on the same test views; instances are the sample."""
    first, second = ({one.subject: one for one in scores_of(record, observed, method)} for method in pair)
    differences = [[_values(first[s], metric) - _values(second[s], metric)] for s in first if s in second]
    return estimate(differences, over="scenes")


def table_of(record: Inference, metric: str, methods: Sequence[str]) -> dict[str, dict[int, Cell]]:
    """Method -> number of views -> mean and difference from the first of ``methods``, one family of tests."""
    counts, first = counts_of(record), methods[0]
    gains = {(name, n): None if name == first else paired(record, metric, n, (name, first)) for name in methods for n in counts}
    adjusted = dict(zip(gains, holm([None if gain is None else gain.p for gain in gains.values()]), strict=True))
    table: dict[str, dict[int, Cell]] = {name: {} for name in methods}
    for (name, n), gain in gains.items():
        mean, p = mean_of(record, metric, n, name), adjusted[name, n]
        table[name][n] = Cell(None if mean is None else mean.mean, gain, p is not None and p < 1 - CONFIDENCE)
    return table


def _values(scores: InstanceScores, metric: str) -> Float[ndarray, " view"]:
    return np.array([np.nan if value is None else value for value in scores.quality.get(metric, ())], dtype=float)
