"""Predictions of a study, judged: the predicted difference with its interval over seeds, and whether it lies within its bounds.

The interval is the one over seeds of `invgraphics.report.statistics.intervals`: for new fits on the same scenes. Fits of one
method pair by seed; fits of two methods are independent groups, as in all comparisons. Factors that no side names are held
equal: differences are taken at those of their levels that all sides have, a stratum each, and averaged over the strata.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.data.factors import METHOD, Lost, Observation
from invgraphics.report.statistics.intervals import Estimate, Groups, over_seeds
from invgraphics.report.statistics.losses import lost_among, scoreless
from invgraphics.report.statistics.pairing import balanced
from invgraphics.report.statistics.values import diverged, value_of
from invgraphics.report.wording import ABSENT, MeasuredQuantity, listing, quality_quantity, significant_decimals
from invgraphics.runs.study import Prediction, level_text

PREDICTION_HEADS = ("Prediction", "Source", "Scenes", "Expected", "Measured", "95% interval", "Fits", "Verdict")
"""Columns of the table of predictions."""
VERDICTS = {"held": "held", "failed": "did not hold", "undecided": "undecided", "open": "not measured"}

Verdict = Literal["held", "failed", "undecided", "open"]

Stratum = tuple[tuple[str, str], ...]
"""(factor, level) of every factor that a prediction does not name."""
Strata = dict[Stratum, dict[int, float]]
"""Stratum -> seed -> score."""
Terms = list[tuple[float, dict[str, str]]]
"""(sign, named levels) of the kinds of fits whose signed sum is predicted."""


@dataclass(frozen=True)
class JudgedPrediction:
    """A prediction beside what was measured.

    Attributes:
        prediction: what was stated.
        quantity: the metric; ``None`` where nothing has it.
        estimate: the difference over these scenes with its interval over seeds; ``None`` where fits of one side are missing.
        scenes: that both sides have fits on.
        lost: failed and diverged fits of both sides: with any, nothing is claimed.
        verdict: ``held`` or ``failed`` where the whole interval lies within or outside the bounds, ``undecided`` where an end
            of one lies within the other or there is no interval, ``open`` where fits are missing.
        reason: why it is ``open``; empty otherwise.
    """

    prediction: Prediction
    quantity: MeasuredQuantity | None
    estimate: Estimate | None
    scenes: tuple[str, ...]
    lost: int
    verdict: Verdict
    reason: str = ""

    @property
    def cells(self) -> tuple[str, ...]:
        """Texts of the columns `PREDICTION_HEADS`."""
        one, value = self.prediction, self.estimate
        digits = _digits(one, self.quantity)
        stated = one.text, one.source, listing(self.scenes) or ABSENT, _bounds(one, digits)
        if value is None or self.quantity is None:
            return *stated, ABSENT, ABSENT, ABSENT, f"{VERDICTS[self.verdict]}: {self.reason}"
        interval = ABSENT if value.unit == "none" else f"{_signed(value.low, digits)} to {_signed(value.high, digits)}"
        words = VERDICTS[self.verdict]
        if self.lost:
            words = f"{words}: {self.lost} {'fit' if self.lost == 1 else 'fits'} lost"
        elif value.unit == "none":
            words = f"{words}: no interval from {value.size}"
        unit = f" {self.quantity.unit}" if self.quantity.unit else ""
        return *stated, f"{_signed(value.mean, digits)}{unit}", interval, value.size, words


def judge_predictions(
    predictions: Sequence[Prediction], observations: Sequence[Observation], lost: Iterable[Lost] = ()
) -> list[JudgedPrediction]:
    """Judge each prediction by a study's finished runs and failed fits."""
    failures = list(lost)
    return [_judge(prediction, observations, failures) for prediction in predictions]


def predictions_sentence(judged: Sequence[JudgedPrediction]) -> str:
    """How many predictions held, failed, are undecided, or have not been measured."""
    counts = {verdict: sum(one.verdict == verdict for one in judged) for verdict in VERDICTS}
    parts = [f"{count} {VERDICTS[verdict]}" for verdict, count in counts.items() if count]
    return f"Of {len(judged)} {'prediction' if len(judged) == 1 else 'predictions'}: {listing(parts)}."


def _judge(prediction: Prediction, observations: Sequence[Observation], failures: Sequence[Lost]) -> JudgedPrediction:
    scored = [one for one in observations if prediction.metric in one.run.scores.quality]
    if not scored:
        reason = f"no finished fit has the metric {prediction.metric}"
        return JudgedPrediction(prediction, None, None, (), 0, "open", reason)
    quantity = quality_quantity(prediction.metric, scored[0].run.scores.quality[prediction.metric])
    names = prediction.scenes or tuple(dict.fromkeys(one.scene for one in observations))
    terms = _terms(prediction)
    found = {name: _groups(terms, quantity, [one for one in scored if one.scene == name]) for name in names}
    known = {name: groups for name, (groups, _) in found.items() if groups}
    value = over_seeds(list(known.values()))
    gone = [one for one in failures if one.scene in names]
    gone += [Lost(one.scene, one.levels) for one in scoreless(observations, quantity) if one.scene in names]
    count = len(lost_among(gone, [one for one in scored if one.scene in names], [levels for _, levels in terms]))
    reason = "; ".join(dict.fromkeys(why for _, why in found.values())) if value is None else ""
    return JudgedPrediction(prediction, quantity, value, tuple(known), count, _verdict(prediction, value, count), reason)


def _verdict(prediction: Prediction, value: Estimate | None, lost: int) -> Verdict:
    if value is None:
        return "open"
    if value.unit == "none" or lost:
        return "undecided"
    low = -math.inf if prediction.low is None else prediction.low
    high = math.inf if prediction.high is None else prediction.high
    if low <= value.low and value.high <= high:
        return "held"
    return "failed" if value.high < low or value.low > high else "undecided"


def _terms(prediction: Prediction) -> Terms:
    """The fits that are added and subtracted: two sides, or with 'against' what they grow by from 'where' to there."""
    places = [(1.0, prediction.against), (-1.0, prediction.where)] if prediction.against else [(1.0, prediction.where)]
    sides = ((1.0, prediction.after), (-1.0, prediction.before))
    return [
        (there * sign, {name: level_text(level) for name, level in {**place, **side}.items()})
        for there, place in places
        for sign, side in sides
    ]


def _groups(terms: Terms, quantity: MeasuredQuantity, here: Sequence[Observation]) -> tuple[Groups, str]:
    """Signed groups of one scene, one for each method that the terms name, and why there are none."""
    named = frozenset(name for _, levels in terms for name in levels)
    tables = [_strata(here, levels, named, quantity) for _, levels in terms]
    for (_, levels), table in zip(terms, tables, strict=True):
        if not table:
            return [], f"no finished fit at {_level_words(levels)}"
    if not set.intersection(*map(set, tables)):
        return [], _apart(tables)
    methods = [levels.get(METHOD) for _, levels in terms]
    sums = []
    for method in dict.fromkeys(methods):
        own = [(sign, table) for (sign, _), table, its in zip(terms, tables, methods, strict=True) if its == method]
        sums.append(_sums(own))
    shared = [stratum for stratum in sums[0] if all(stratum in table for table in sums)]
    groups = [(1.0, _by_seed(table, shared, whole=len(sums) > 1)) for table in sums]
    if not all(len(values) for _, values in groups):
        return [], "no seed has fits of all sides at the same levels of the factors that are not named"
    return groups, ""


def _strata(
    here: Sequence[Observation], wanted: Mapping[str, str], named: frozenset[str], quantity: MeasuredQuantity
) -> Strata:
    """Scores of the fits at some levels; over factors that other terms alone name they are means, where none is missing."""
    found: dict[tuple[Stratum, int], dict[Stratum, float]] = {}
    for one in here:
        value = value_of(one.run, quantity) if _has(one.levels, wanted) and not diverged(one.run, quantity) else None
        if value is not None and math.isfinite(value):
            levels = sorted(one.levels.items())
            others = tuple(pair for pair in levels if pair[0] not in named)
            free = tuple(pair for pair in levels if pair[0] in named and pair[0] not in wanted)
            found.setdefault((others, one.run.seed), {})[free] = value
    most = len({free for values in found.values() for free in values})
    strata: Strata = {}
    for (others, seed), values in found.items():
        if len(values) == most:
            strata.setdefault(others, {})[seed] = sum(values.values()) / most
    return strata


def _sums(own: Sequence[tuple[float, Strata]]) -> Strata:
    """Signed sums of the fits of one method, which pair by stratum and seed."""
    first = own[0][1]
    sums: Strata = {}
    for stratum, seeds in first.items():
        for seed in seeds:
            if all(seed in table.get(stratum, ()) for _, table in own):
                sums.setdefault(stratum, {})[seed] = sum(sign * table[stratum][seed] for sign, table in own)
    return sums


def _by_seed(table: Strata, shared: Sequence[Stratum], whole: bool) -> Float[ndarray, " seed"]:
    """One value per seed, its mean over strata, since they add no independent seed.

    Args:
        table: of one method.
        shared: the strata that all methods have.
        whole: leave out seeds that lack one of them: only where differences within a method are all may strata go instead.
    """
    if not whole:
        return np.array(list(balanced({stratum: table[stratum] for stratum in shared}).values()))
    found: dict[int, list[float]] = {}
    for stratum in shared:
        for seed, value in table[stratum].items():
            found.setdefault(seed, []).append(value)
    return np.array([sum(values) / len(values) for values in found.values() if len(values) == len(shared)])


def _apart(tables: Sequence[Strata]) -> str:
    """Why sides have no stratum in common: the factors of which they have no level in common, where single ones say it."""
    levels = [{pair for stratum in table for pair in stratum} for table in tables]
    common = {name for name, _ in set.intersection(*levels)}
    names = [name for name, _ in next(iter(tables[0])) if name not in common]
    return (
        f"its sides have no level of {listing(names)} in common" if names else "its sides differ in factors that are not named"
    )


def _level_words(levels: Mapping[str, str]) -> str:
    return listing(level if name == METHOD else f"{name} {level}" for name, level in levels.items())


def _has(levels: Mapping[str, str], wanted: Mapping[str, str]) -> bool:
    return all(levels.get(name) == level for name, level in wanted.items())


def _digits(prediction: Prediction, quantity: MeasuredQuantity | None) -> int:
    """Digits after the point: those of the metric, of three significant ones, or as many as the stated bounds have."""
    bounds = [bound for bound in (prediction.low, prediction.high) if bound is not None]
    written = [len(f"{bound:.6f}".rstrip("0").partition(".")[2]) for bound in bounds]
    own = 2 if quantity is None else quantity.decimals
    return max(*written, significant_decimals(max(map(abs, bounds))) if own is None else own)


def _bounds(prediction: Prediction, digits: int) -> str:
    if prediction.low is None:
        assert prediction.high is not None
        return f"at most {_signed(prediction.high, digits)}"
    if prediction.high is None:
        return f"at least {_signed(prediction.low, digits)}"
    return f"{_signed(prediction.low, digits)} to {_signed(prediction.high, digits)}"


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")
