"""Factors of a study: their names, the methods in their scope, and those that are settings of the request."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatch
from typing import Any

from invgraphics.errors import InputError
from invgraphics.tables import inline_toml

Levels = dict[str, Any]
"""Factor -> level."""

BUDGET, SIZE, PRESET = "budget", "size", "preset"

SETTINGS = (BUDGET, SIZE, PRESET)
"""Factors that are settings of the request, not keys of the recipe or of the training data."""

NARROWING = ("scenes", "methods", "seeds")
"""Keys of a listed cell that say for which of the study's scenes, methods and seeds it holds; absent ones mean all."""


def in_scope(factor: str, method: str) -> bool:
    """Whether a method is in the scope of a factor (or of a key of the base)."""
    scope, colon, _ = factor.rpartition(":")
    return not colon or fnmatch(method, scope)


def path_of(factor: str) -> str:
    """Dotted path of the setting that a factor changes, without its scope."""
    return factor.rpartition(":")[2]


def levels_of(cell: Mapping[str, Any]) -> Levels:
    """Levels of a listed cell, without the keys that restrict its scenes, methods and seeds."""
    return {name: level for name, level in cell.items() if name not in NARROWING}


def covers(cell: Mapping[str, Any], scene: str, method: str, seed: int) -> bool:
    """Whether a listed cell applies to a scene, a method and a seed."""
    return all(value in cell.get(key, (value,)) for key, value in zip(NARROWING, (scene, method, seed), strict=True))


def override(path: str, level: Any) -> str:
    """Format a level for ``--set``: ``path=value`` in TOML, on one line.

    Raises:
        InputError: TOML has no such value.
    """
    try:
        return f"{path}={inline_toml(level)}"
    except ValueError as error:
        raise InputError(
            f"'{path}' cannot be set to {level!r}: {error}.", "Expected: what a recipe in TOML can hold."
        ) from error
