"""Factors with the levels observed in a study's cells, and display names of its variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatch

from invgraphics.report.data.factors import METHOD, Factor, StudyCell
from invgraphics.runs.study import StudyRecord, level_text


def find_factors(record: StudyRecord, base: Mapping[str, str], cells: Sequence[StudyCell]) -> tuple[Factor, ...]:
    """Factors with at least two observed levels: the method, declared factors, then others that vary between cells."""
    levels: dict[str, dict[str, None]] = {METHOD: {}}
    for path, values in record.factors.items():
        listed = values if isinstance(values, list | tuple) else [values]
        levels[str(path)] = dict.fromkeys(level_text(value) for value in listed)
    present: dict[str, set[str]] = {}
    for cell in cells:
        for path, level in cell.levels.items():
            levels.setdefault(path, {}).setdefault(level, None)
            present.setdefault(path, set()).add(level)
    factors = []
    for path, found in levels.items():
        kept = tuple(level for level in found if level in present.get(path, ()))
        if len(kept) > 1:
            words = {level: record.words[name] for level in kept if (name := f"{path} {level}") in record.words}
            factors.append(Factor(path, kept, base[path] if base.get(path) in kept else kept[0], words))
    return tuple(factors)


BASE = "base"
"""The variant with every factor at its reference level, where all have one method."""


def variant_name(cell: StudyCell, factors: Sequence[Factor]) -> str:
    """Display name of a cell: its method, and in words what differs from the base; factors of other methods are left out."""
    names = short_names([factor.path for factor in factors])
    own = [f for f in factors if f.path != METHOD and f.path in cell.levels and _concerns(f.path, cell.method)]
    changed = [_words(f, cell.levels[f.path], names) for f in own if cell.levels[f.path] != f.reference]
    parts = [cell.method] if any(factor.path == METHOD for factor in factors) else []
    return ", ".join([*parts, *changed]) or (BASE if own else cell.method)


def base_words(factors: Sequence[Factor]) -> str:
    """The base in words: the reference level of every factor but the method."""
    names = short_names([factor.path for factor in factors])
    return ", ".join(_words(factor, factor.reference, names) for factor in factors if factor.path != METHOD)


def _words(factor: Factor, level: str, names: Mapping[str, str]) -> str:
    """A factor's level as the study calls it, else by the factor's short name."""
    return factor.words.get(level) or level_words(names[factor.path], level)


def level_words(name: str, level: str) -> str:
    """A factor's level in words: ``train_views 20``; of a switch ``clone`` or ``no clone``."""
    if level in ("true", "false"):
        words = name.rpartition(".")[2].rpartition(":")[2].replace("_", " ")
        return words if level == "true" else f"no {words}"
    return f"{name} {level}"


def setting_words(levels: Mapping[str, str], factors: Sequence[Factor]) -> str:
    """Levels of several factors in words, the method first; factors of other methods are left out."""
    known, names = {factor.path: factor for factor in factors}, short_names(list(levels))
    method = levels.get(METHOD, "")
    own = [(path, level) for path, level in levels.items() if path != METHOD and (not method or _concerns(path, method))]
    words = [_words(known[path], level, names) if path in known else level_words(names[path], level) for path, level in own]
    return ", ".join([method] * bool(method) + words)


def _concerns(path: str, method: str) -> bool:
    """Whether a factor applies to ``method``: ``volumetric/*:batches.rays`` names the methods before its colon."""
    pattern, colon, _ = path.rpartition(":")
    return not colon or fnmatch(method, pattern)


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Dotted path -> its shortest unique suffix."""
    split = {path: path.split(".") for path in paths}
    names = {}
    for path, parts in split.items():
        lengths = range(1, len(parts) + 1)
        clear = (n for n in lengths if sum(other[-n:] == parts[-n:] for other in split.values()) == 1)
        names[path] = ".".join(parts[-next(clear, len(parts)) :])
    return names
