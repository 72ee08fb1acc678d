"""Validation of what a study states and asks before anything runs: each part must be something that its cells can answer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from invgraphics.errors import InputError, did_you_mean
from invgraphics.metrics.keys import quality_keys
from invgraphics.report.wording import COSTS
from invgraphics.runs.study import Prediction, level_text
from invgraphics.studies.factors import path_of
from invgraphics.studies.study import Cell, Study

METHOD = "method"
"""The method is a factor like any other, under this name."""
TEST_SCALES = "data.test_scales"

Levels = Mapping[str, Any]


def check_questions(study: Study, where: str) -> None:
    """Check that what the report is to tell exists: factors and levels, metrics, and the cells of every comparison.

    Raises:
        InputError: it does not, so that the report would leave it out, or say after all fits that nothing measured it.
    """
    known = {METHOD, *study.factors}
    for name in [study.each] * bool(study.each) + [name for pair in study.interactions for name in pair]:
        if name not in known:
            raise InputError(
                f"{where}: the question names '{name}', which is no factor.", f"Expected: {', '.join(sorted(known))}."
            )
    levels = {f"{name} {level_text(level)}" for name, listed in study.factors.items() for level in listed}
    if strange := [name for name in study.words if name not in levels]:
        raise InputError(f"{where}: [words] names '{strange[0]}', which is no level.{did_you_mean(strange[0], sorted(levels))}")
    quality = _quality_keys(study)
    _check_metric(study.metric, quality, f"{where}: the key 'metric'")
    for metric, margin in study.margins.items():
        _check_metric(metric, [*quality, *(cost.key for cost in COSTS)], f"{where}: [margins]")
        if not 0 < margin < math.inf:
            raise InputError(f"{where}: the margin of '{metric}' cannot be {margin}.", "Expected: a positive difference.")
    cells = study.expand() if study.interactions or study.predictions else []
    for first, second in study.interactions:
        _check_interaction(first, second, study, cells, where)
    for number, prediction in enumerate(study.predictions, 1):
        _check_prediction(prediction, study, f"{where}: prediction {number}")
        _check_metric(prediction.metric, quality, f"{where}: prediction {number}")
        _check_measurable(prediction, cells, f"{where}: prediction {number}")


def _quality_keys(study: Study) -> list[str]:
    """Keys of the scores that the study's fits can have."""
    listed = [level for name, level in study.base.items() if path_of(name) == TEST_SCALES]
    listed += [level for name, levels in study.factors.items() if path_of(name) == TEST_SCALES for level in levels]
    return quality_keys(dict.fromkeys(divisor for level in listed if isinstance(level, list) for divisor in level))


def _check_metric(metric: str, known: Sequence[str], where: str) -> None:
    if metric not in known:
        raise InputError(
            f"{where} names the metric '{metric}', which no fit of the study has.{did_you_mean(metric, known)}",
            f"Known: {', '.join(known)}; of smaller pictures, psnr_at_1_2 and so on where {TEST_SCALES} names the divisor.",
        )


def _check_interaction(first: str, second: str, study: Study, cells: Sequence[Cell], where: str) -> None:
    """Check that cells exist at all four combinations of the outermost levels, which the report compares."""
    if first == second:
        raise InputError(f"{where}: '{first}' cannot interact with itself.")
    ends = []
    for name in (first, second):
        held = dict.fromkeys(level_text(_levels(cell)[name]) for cell in cells)
        listed = study.factors.get(name, list(held))  # methods in the order of the cells, as in the report
        present = [level for level in listed if level_text(level) in held]
        if len(present) < 2:
            raise InputError(f"{where}: '{name}' has a single level, so that nothing can interact with it.")
        ends.append((present[0], present[-1]))
    corners = [{first: one, second: two} for one in ends[0] for two in ends[1]]
    _check_comparable(corners, cells, f"{where}: the interaction of '{first}' and '{second}'")


def _check_prediction(prediction: Prediction, study: Study, where: str) -> None:
    """Check that a prediction names scenes, factors and levels of the study, and that its two sides differ."""
    levels: dict[str, Sequence[Any]] = {METHOD: study.methods, **study.factors}
    for side in ("before", "after", "where", "against"):
        for name, level in getattr(prediction, side).items():
            if name not in levels:
                raise InputError(f"{where} names '{name}', which is no factor.", f"Expected: {', '.join(sorted(levels))}.")
            if level not in levels[name]:
                listed = ", ".join(map(repr, levels[name]))
                raise InputError(f"{where} names '{name}' = {level!r}, which is none of its levels.", f"Expected: {listed}.")
    if strange := [scene for scene in prediction.scenes if scene not in study.scenes]:
        raise InputError(f"{where} names {strange[0]!r}, which is none of the study's scenes.", ", ".join(study.scenes))
    if prediction.before == prediction.after:
        raise InputError(f"{where}: 'before' and 'after' are the same fits.")
    if prediction.against and prediction.against.keys() != prediction.where.keys():
        raise InputError(f"{where}: 'against' must name the factors of 'where', at other levels.")


def _check_measurable(prediction: Prediction, cells: Sequence[Cell], where: str) -> None:
    """Check that cells exist which the report can compare for a prediction."""
    places = [prediction.where, prediction.against] if prediction.against else [prediction.where]
    kinds = [{**place, **side} for place in places for side in (prediction.before, prediction.after)]
    _check_comparable(kinds, [cell for cell in cells if cell.scene in (prediction.scenes or (cell.scene,))], where)


def _check_comparable(kinds: Sequence[Levels], cells: Sequence[Cell], what: str) -> None:
    """Check that some scene has cells of all kinds at the same other levels; of one method also with the same seed.

    Args:
        kinds: levels of each kind of cell.
        cells: of the study.
        what: needs them, as the subject of a sentence.
    """
    named = {name for kind in kinds for name in kind}
    remedy = (
        "Needed are cells at each of these combinations, with the levels of all other factors the same, as in a full factorial."
    )
    rows = [(cell, {name: level_text(level) for name, level in _levels(cell).items()}) for cell in cells]
    found: dict[Any, set[tuple[Any, int]]] = {}
    for kind in kinds:
        wanted = {name: level_text(level) for name, level in kind.items()}
        own = [(cell, levels) for cell, levels in rows if wanted.items() <= levels.items()]
        if not own:
            words = " and ".join(f"{name} = {level}" for name, level in wanted.items())
            raise InputError(f"{what} cannot be measured: no cell has {words}.", remedy)
        others = [tuple(pair for pair in levels.items() if pair[0] not in named) for _, levels in own]
        places = {((cell.scene, rest), cell.seed) for (cell, _), rest in zip(own, others, strict=True)}
        method = kind.get(METHOD)
        found[method] = found.get(method, places) & places
    if not set.intersection(*({place for place, _ in places} for places in found.values())):
        raise InputError(f"{what} cannot be measured: its sides have no scene and other levels in common.", remedy)


def _levels(cell: Cell) -> dict[str, Any]:
    return {METHOD: cell.method, **cell.levels}
