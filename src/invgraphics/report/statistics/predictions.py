"""Predictions of a study, judged: the predicted difference with its intervals, and whether it lies within its bounds.

The intervals are those of `invgraphics.report.statistics.intervals`, for new fits on the same scenes and for scenes like these;
a verdict rests on the latter where there are several scenes, as in all comparisons. Fits of one method pair by seed; those of
two methods are independent groups. Factors that no side names are held equal: differences are taken at those of their levels
that all sides have, a stratum each, and averaged over the strata.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from invgraphics.report.data.factors import METHOD, FailedFit, Observation
from invgraphics.report.statistics.failures import failures_among, scoreless
from invgraphics.report.statistics.intervals import CONFIDENCE, Estimate, Groups, over_scenes, over_seeds
from invgraphics.report.statistics.pairing import balanced
from invgraphics.report.statistics.values import diverged, run_values, value_of
from invgraphics.report.wording import ABSENT, MeasuredQuantity, listing, quality_quantity, significant_decimals
from invgraphics.runs.study import Prediction, level_text

INTERVALS = ("95%, these scenes", "95%, scenes like these")
PREDICTION_HEADS = ("Prediction", "Source", "Scenes", "Expected", "Measured", *INTERVALS, "Fits", "Verdict")
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
        verdict: ``held`` or ``failed`` where the whole interval of `claim` lies within or outside the bounds, ``undecided``
            where an end of one lies within the other or there is no interval, ``open`` where fits are missing.
        reason: why it is ``open``, or why it is ``undecided`` though the interval says something.
        across: the difference with its interval over scenes; ``None`` for one scene.
    """

    prediction: Prediction
    quantity: MeasuredQuantity | None
    estimate: Estimate | None
    scenes: tuple[str, ...]
    lost: int
    verdict: Verdict
    reason: str = ""
    across: Estimate | None = None

    @property
    def claim(self) -> Estimate | None:
        """The estimate that the verdict rests on: over scenes where there are several, else over seeds."""
        return self.estimate if self.across is None else self.across

    @property
    def cells(self) -> tuple[str, ...]:
        """Texts of the columns `PREDICTION_HEADS`."""
        one, value = self.prediction, self.estimate
        digits = _digits(one, self.quantity)
        stated = one.text, one.source, listing(self.scenes) or ABSENT, _bounds(one, digits)
        if value is None or self.quantity is None:
            return *stated, ABSENT, ABSENT, ABSENT, ABSENT, f"{VERDICTS[self.verdict]}: {self.reason}"
        intervals = (_interval(bar, digits) for bar in (value, self.across))
        words = f"{VERDICTS[self.verdict]}{': ' if self.reason else ''}{self.reason}"
        unit = f" {self.quantity.unit}" if self.quantity.unit else ""
        return *stated, f"{_signed(value.mean, digits)}{unit}", *intervals, value.size, words


def judge_predictions(
    predictions: Sequence[Prediction],
    observations: Sequence[Observation],
    lost: Iterable[FailedFit] = (),
    scenes: Sequence[str] = (),
) -> list[JudgedPrediction]:
    """Judge each prediction by a study's finished runs and failed fits, those without scenes on all of its own."""
    failures, known = list(lost), tuple(dict.fromkeys([*scenes, *(one.scene for one in observations)]))
    return [_judge(prediction, observations, failures, prediction.scenes or known) for prediction in predictions]


def predictions_sentence(judged: Sequence[JudgedPrediction]) -> str:
    """How many predictions held, failed, are undecided, or have not been measured."""
    counts = {verdict: sum(one.verdict == verdict for one in judged) for verdict in VERDICTS}
    parts = [f"{count} {VERDICTS[verdict]}" for verdict, count in counts.items() if count]
    return f"Of {len(judged)} {'prediction' if len(judged) == 1 else 'predictions'}: {listing(parts)}."


def _judge(
    prediction: Prediction, observations: Sequence[Observation], failures: Sequence[FailedFit], names: Sequence[str]
) -> JudgedPrediction:
    scored = [one for one in observations if prediction.metric in one.run.scores.quality]
    if not scored:
        reason = f"no finished fit has the metric {prediction.metric}"
        return JudgedPrediction(prediction, None, None, (), 0, "open", reason)
    quantity = quality_quantity(prediction.metric, scored[0].run.scores.quality[prediction.metric])
    terms = _terms(prediction)
    found = {name: _groups(terms, quantity, [one for one in scored if one.scene == name]) for name in names}
    known = {name: groups for name, (groups, _) in found.items() if groups}
    size = max((abs(score) for one in scored if math.isfinite(score := value_of(one.run, quantity) or 0.0)), default=0.0)
    value = over_seeds(list(known.values()), scores=size)
    gone = [one for one in failures if one.scene in names]
    gone += [FailedFit(one.scene, one.levels) for one in scoreless(observations, quantity) if one.scene in names]
    count = len(failures_among(gone, [one for one in scored if one.scene in names], [levels for _, levels in terms]))
    if value is None:
        reason = "; ".join(dict.fromkeys(why for _, why in found.values()))
        return JudgedPrediction(prediction, quantity, None, (), count, "open", reason)
    across = over_scenes(list(known.values()), least_error=value.error, scores=size) if len(known) > 1 else None
    claim = value if across is None else across
    reason = _unsettled(prediction, claim, known, count, [name for name in names if name not in known])
    verdict = "undecided" if reason else _within(prediction, claim)
    return JudgedPrediction(prediction, quantity, value, tuple(known), count, verdict, reason, across)


def _unsettled(prediction: Prediction, claim: Estimate, known: Mapping[str, Groups], lost: int, missing: Sequence[str]) -> str:
    """Why a prediction is undecided whatever the interval of all scenes says; empty where that decides it.

    A scene contradicts by its own interval, which is corrected for their number (Bonferroni).
    """
    if lost:
        return f"{lost} {'fit' if lost == 1 else 'fits'} lost"
    if missing:
        return f"no fits of all sides on {listing(missing)}"
    if claim.unit == "none":
        return f"no interval from {claim.size}"
    confidence = 1 - (1 - CONFIDENCE) / len(known)
    alone = {name: _within(prediction, own) for name, groups in known.items() if (own := over_seeds([groups], confidence))}
    contrary: Verdict = "failed" if _within(prediction, claim) == "held" else "held"
    scenes = [name for name, one in alone.items() if one == contrary]
    if scenes and _within(prediction, claim) != "undecided":
        return f"{'did not hold' if contrary == 'failed' else 'held'} on {listing(scenes)}"
    return ""


def _within(prediction: Prediction, value: Estimate) -> Verdict:
    """Whether an interval lies within the bounds of a prediction, outside, or across one of them."""
    low = -math.inf if prediction.low is None else prediction.low
    high = math.inf if prediction.high is None else prediction.high
    if value.unit == "none":
        return "undecided"
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
    scores = _scores(here, terms, named, quantity)
    tables = [_strata(scores, levels, named) for _, levels in terms]
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


def _scores(
    here: Sequence[Observation], terms: Terms, named: frozenset[str], quantity: MeasuredQuantity
) -> list[tuple[Observation, float]]:
    """Fits of a scene at the levels of any term with their scores, over the views in which all that are compared have one.

    These are fits of one seed, which pair, or of all seeds where terms are of several methods; of one stratum in any case.
    """
    pairs = len({levels.get(METHOD) for _, levels in terms}) == 1
    compared: dict[tuple[Any, ...], list[Observation]] = {}
    for one in here:
        value = None if diverged(one.run, quantity) else value_of(one.run, quantity)
        if value is not None and math.isfinite(value) and any(_has(one.levels, levels) for _, levels in terms):
            others = sorted(pair for pair in one.levels.items() if pair[0] not in named)
            compared.setdefault((*others, one.run.seed if pairs else None), []).append(one)
    values = ((fits, run_values([one.run for one in fits], quantity)) for fits in compared.values())
    return [pair for fits, scores in values if scores is not None for pair in zip(fits, scores, strict=True)]


def _strata(scores: Sequence[tuple[Observation, float]], wanted: Mapping[str, str], named: frozenset[str]) -> Strata:
    """Scores of the fits at some levels; over factors that other terms alone name they are means, where none is missing."""
    found: dict[tuple[Stratum, int], dict[Stratum, float]] = {}
    for one, value in scores:
        if _has(one.levels, wanted):
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


def _interval(value: Estimate | None, digits: int) -> str:
    if value is None or value.unit == "none":
        return ABSENT
    return f"{_signed(value.low, digits)} to {_signed(value.high, digits)}"


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")
