"""Completion and validation of study tables, without heavy imports."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from invgraphics.errors import InputError
from invgraphics.studies.analyses import check_analyses
from invgraphics.studies.factors import BUDGET, NARROWING, PRESET, SETTINGS, SIZE, in_scope, levels_of, path_of
from invgraphics.studies.questions import check_questions
from invgraphics.studies.study import Study
from invgraphics.training.budget import Budget

MOST_CELLS = 10_000
"""Runs of a study: as many take a week at a minute each."""


def completed(study: Study, where: str) -> Study:
    """Complete a study: flat factor names, the factors of listed cells, and a base level for every factor."""
    base = _flat(study.base)
    cells = tuple(_flat(cell) for cell in study.cells)
    factors = _flat(study.factors)
    for name, levels in factors.items():
        if not isinstance(levels, list):
            raise InputError(f"{where}: the factor '{name}' is not a list of levels.", f"Expected: [{levels!r}, ...].")
    if (study.design == "list") != bool(cells) or (study.design == "list" and factors):
        raise InputError(f"{where}: the design 'list' needs [[cells]] and no [factors], the others the contrary.")
    defaults = {name: value for name in SETTINGS if (value := getattr(study, name)) is not None}
    for name in dict.fromkeys(name for cell in cells for name in levels_of(cell)):
        absent = [index for index, cell in enumerate(cells) if name not in cell]
        if absent and name in defaults:
            base.setdefault(name, list(defaults[name]) if isinstance(defaults[name], tuple) else defaults[name])
        if absent and name not in base:
            raise InputError(f"{where}: cell {absent[0] + 1} has no '{name}', and neither has [base].")
        found = ([base[name]] if absent else []) + [cell[name] for cell in cells if name in cell]
        factors[name] = [level for index, level in enumerate(found) if level not in found[:index]]
    first = {name: levels[0] for name, levels in factors.items() if levels}
    predictions = tuple(
        replace(one, **{side: _flat(getattr(one, side)) for side in ("before", "after", "where", "against")})
        for one in study.predictions
    )
    return replace(study, base=first | base, factors=factors, cells=cells, predictions=predictions)


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables to one with dotted names."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def checked(study: Study, where: str) -> Study:
    """Validate a study: it can be expanded, and no run would be in vain."""
    for what in NARROWING:
        _check_list(getattr(study, what), f"{where}: '{what}'")
    _check_scenes(study.scenes, f"{where}: 'scenes'")
    _check_narrowing(study, where)
    _check_count(study, where)
    for name, levels in study.factors.items():
        _check_list(levels, f"{where}: the factor '{name}'")
        if study.base[name] not in levels:
            raise InputError(f"{where}: [base] gives '{name}' the value {study.base[name]!r}, which is none of its levels.")
    for name, value in study.base.items():
        values = study.factors.get(name, [value])
        if strange := [value for value in values if not _is_plain(value)]:
            raise InputError(f"{where}: '{name}' cannot be {strange[0]!r}.", _PLAIN)
        if not any(in_scope(name, method) for method in study.methods):
            raise InputError(f"{where}: '{name}' belongs to none of the study's methods ({', '.join(study.methods)}).")
        for level in values:
            _check_setting(path_of(name), level, where)
    for method in study.methods:
        paths = [path_of(name) for name in study.base if in_scope(name, method)]
        if twice := [path for path in paths if paths.count(path) > 1]:
            raise InputError(
                f"{where}: '{twice[0]}' is set by two entries for {method}.", "Let their scopes exclude each other."
            )
    check_questions(study, where)
    check_analyses(study.analyses, where)
    for name in (name for pair in study.approximations for name in (pair.exact, pair.approximate)):
        if name not in study.render_with:
            raise InputError(f"{where}: an approximation names '{name}', which is not in 'render_with'.")
    Budget.parse(study.budget)
    views = study.test_views
    if any(seed < 0 for seed in study.seeds) or (views != "all" and views < 1):
        raise InputError(f"{where}: seeds must be 0 or more, and 'test_views' 1 or more or 'all'.")
    return study


def _check_count(study: Study, where: str) -> None:
    """Refuse a study whose number of cells is too large to be expanded."""
    levels = [len(levels) for levels in study.factors.values()]
    points = {"factorial": math.prod(levels), "one-at-a-time": 1 + sum(levels), "list": len(study.cells)}[study.design]
    count = points * len(study.scenes) * len(study.methods) * len(study.seeds)
    if count > MOST_CELLS:
        raise InputError(
            f"{where} has {count:,} cells; a study has at most {MOST_CELLS:,}.",
            "Give fewer levels in [factors], or the design 'one-at-a-time'.",
        )


def _check_narrowing(study: Study, where: str) -> None:
    """Check that listed cells name only scenes, methods and seeds of the study."""
    for number, cell in enumerate(study.cells, 1):
        for what in NARROWING:
            own, all_of_them = cell.get(what, []), getattr(study, what)
            if not isinstance(own, list) or (what in cell and not own):
                raise InputError(f"{where}: cell {number} has no list of '{what}', but {own!r}.", f"Expected: [{own!r}, ...].")
            if strange := [item for item in own if item not in all_of_them]:
                listed = ", ".join(map(str, all_of_them))
                raise InputError(f"{where}: cell {number} names {strange[0]!r}, which is none of the study's {what}.", listed)


def _check_setting(name: str, level: Any, where: str) -> None:
    """Check that the level of a budget, size or preset is valid."""
    if name == BUDGET:
        Budget.parse(str(level))
    sides = level if isinstance(level, list) and len(level) == 2 else [level]
    if name == SIZE and not all(isinstance(side, int) and not isinstance(side, bool) and side > 0 for side in sides):
        raise InputError(f"{where}: 'size' cannot be {level!r}.", "Expected: the longest side in pixels, or [width, height].")
    if name == PRESET and not isinstance(level, str):
        raise InputError(f"{where}: 'preset' cannot be {level!r}.", "Expected: a preset's name in quotes.")


_PLAIN = "Expected: a number, a text, true, false, or a list of such."


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))


def _check_list(items: Sequence[Any], what: str) -> None:
    if not items:
        raise InputError(f"{what} has no entries.")
    for index, item in enumerate(items):
        if item in items[:index]:
            raise InputError(f"{what} has {item!r} twice.")


def _check_scenes(scenes: Sequence[str], what: str) -> None:
    """Check that no two entries lead to the same data set, by whatever path."""
    places = [os.path.realpath(os.path.expandvars(scene)) for scene in scenes]
    for index, place in enumerate(places):
        if place in places[:index]:
            raise InputError(f"{what} has one data set twice, as {scenes[places.index(place)]!r} and {scenes[index]!r}.")
