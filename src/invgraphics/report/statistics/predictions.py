"""Predictions of a study, judged: the predicted difference with its interval over seeds, and whether it lies within its bounds.

The interval is the one over seeds of `invgraphics.report.statistics.intervals`: for new fits on the same scenes. Fits of one
method pair by seed; fits of two methods are independent groups, as in all comparisons.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from invgraphics.report.data.factors import METHOD, Lost, Observation
from invgraphics.report.statistics.intervals import Estimate, Groups, over_seeds
from invgraphics.report.statistics.values import diverged, value_of
from invgraphics.report.wording import ABSENT, Quantity, listing, quality_quantity
from invgraphics.runs.study import Prediction, level_text

PREDICTION_HEADS = ("Prediction", "Source", "Scenes", "Expected", "Measured", "95% interval", "Fits", "Verdict")
"""Columns of the table of predictions."""
VERDICTS = {"held": "held", "failed": "did not hold", "undecided": "undecided", "open": "not measured"}

Verdict = Literal["held", "failed", "undecided", "open"]


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
    """

    prediction: Prediction
    quantity: Quantity | None
    estimate: Estimate | None
    scenes: tuple[str, ...]
    lost: int
    verdict: Verdict

    @property
    def cells(self) -> tuple[str, ...]:
        """Texts of the columns `PREDICTION_HEADS`."""
        one, value = self.prediction, self.estimate
        stated = one.text, one.source, listing(self.scenes) or ABSENT, _bounds(one)
        if value is None or self.quantity is None:
            return *stated, ABSENT, ABSENT, ABSENT, VERDICTS[self.verdict]
        interval = ABSENT if value.unit == "none" else f"{_signed(value.low)} to {_signed(value.high)}"
        words = VERDICTS[self.verdict]
        if self.lost:
            words = f"{words}: {self.lost} {'fit' if self.lost == 1 else 'fits'} lost"
        elif value.unit == "none":
            words = f"{words}: no interval from {value.size}"
        unit = f" {self.quantity.unit}" if self.quantity.unit else ""
        return *stated, f"{_signed(value.mean)}{unit}", interval, value.size, words


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
        return JudgedPrediction(prediction, None, None, (), 0, "open")
    quantity = quality_quantity(prediction.metric, scored[0].run.scores.quality[prediction.metric])
    names = prediction.scenes or tuple(dict.fromkeys(one.scene for one in observations))
    groups = {name: _groups(prediction, quantity, [one for one in scored if one.scene == name]) for name in names}
    known = {name: found for name, found in groups.items() if found}
    value = over_seeds(list(known.values()))
    sides = [_levels(prediction, side, there) for side in ("before", "after") for there in _places(prediction)]
    gone = [one for one in failures if one.scene in names]
    gone += [Lost(one.scene, one.levels) for one in observations if one.scene in names and diverged(one.run, quantity)]
    count = sum(any(_has(one.levels, side) for side in sides) for one in gone)
    return JudgedPrediction(prediction, quantity, value, tuple(known), count, _verdict(prediction, value, count))


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


def _groups(prediction: Prediction, quantity: Quantity, here: Sequence[Observation]) -> Groups:
    """Signed groups of one scene: differences paired by seed, or one group for each of two methods."""
    sides = []
    for side in ("after", "before"):
        scores = [_by_seed(here, _levels(prediction, side, there), quantity) for there in _places(prediction)]
        # With 'against', a side is its growth from 'where' to there; seeds that lack an end are left out.
        sides.append(scores[0] if len(scores) == 1 else {s: scores[1][s] - scores[0][s] for s in scores[0] if s in scores[1]})
    after, before = sides
    if prediction.before.get(METHOD) != prediction.after.get(METHOD):
        independent = [(1.0, np.array(list(after.values()))), (-1.0, np.array(list(before.values())))]
        return independent if after and before else []
    shared = np.array([after[seed] - before[seed] for seed in after if seed in before])
    return [(1.0, shared)] if len(shared) else []


def _places(prediction: Prediction) -> list[Mapping[str, Any]]:
    return [prediction.where, prediction.against] if prediction.against else [prediction.where]


def _levels(prediction: Prediction, side: str, there: Mapping[str, Any]) -> dict[str, str]:
    return {name: level_text(level) for name, level in {**there, **getattr(prediction, side)}.items()}


def _has(levels: Mapping[str, str], wanted: Mapping[str, str]) -> bool:
    return all(levels.get(name) == level for name, level in wanted.items())


def _by_seed(here: Sequence[Observation], wanted: Mapping[str, str], quantity: Quantity) -> dict[int, float]:
    """Seed -> score of the fits at some levels; factors that are not named are averaged."""
    found: dict[int, list[float]] = {}
    for one in here:
        value = value_of(one.run, quantity) if _has(one.levels, wanted) and not diverged(one.run, quantity) else None
        if value is not None and math.isfinite(value):
            found.setdefault(one.run.seed, []).append(value)
    return {seed: sum(values) / len(values) for seed, values in found.items()}


def _bounds(prediction: Prediction) -> str:
    if prediction.low is None:
        assert prediction.high is not None
        return f"at most {_signed(prediction.high)}"
    if prediction.high is None:
        return f"at least {_signed(prediction.low)}"
    return f"{_signed(prediction.low)} to {_signed(prediction.high)}"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")
