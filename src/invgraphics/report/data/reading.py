"""Run folders and comparison folders, read and checked. Nothing here interprets a number."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from invgraphics.errors import InputError
from invgraphics.report.data.records import Comparison, Failure, Progress, Run, Score

T = TypeVar("T")

Table = Mapping[str, Any]


def read_comparison(folder: Path) -> Comparison:
    """Read a folder that ``compare`` wrote.

    Raises:
        InputError: a file is missing or broken (it is named), or the runs do not share their ground truth.
    """
    source = folder / "compare.json"
    table = read_table(source)
    protocol = optional(table, "protocol", dict, source, {})
    name = str(protocol.get("name", "default"))
    runs = tuple(read_run(folder / str(path), name) for path in need(table, "runs", list, source))
    failures = tuple(
        Failure(need(entry, "method", str, source), need(entry, "seed", int, source), need(entry, "error", str, source))
        for entry in optional(table, "failures", list, source, [])
    )
    if not runs and not failures:
        raise InputError(f"'{source}' lists no runs.", "Run `invgraphics compare` again.")
    check_comparable(runs)
    baselines = optional(table, "baselines", dict, source, {})
    size = optional(table, "size", list, source, [])
    named = [str(method) for method in need(table, "methods", list, source)]
    found = [run.method for run in runs] + [failure.method for failure in failures]
    return Comparison(
        scene=need(table, "scene", str, source),
        question=optional(table, "question", str, source, ""),
        methods=tuple(dict.fromkeys([*named, *found])),
        runs=runs,
        failures=failures,
        budget=optional(table, "budget", str, source, ""),
        preset=optional(table, "preset", str, source, ""),
        size=(int(size[0]), int(size[1])) if len(size) == 2 else None,
        summaries={str(k): str(v) for k, v in optional(table, "summaries", dict, source, {}).items()},
        command=optional(table, "command", str, source, ""),
        baselines={name: read_quality(quality, source) for name, quality in baselines.items()},
        noise_ceiling=number(table.get("noise_ceiling"), "noise_ceiling", source),
        protocol=protocol,
        scene_info=optional(table, "scene_info", dict, source, {}),
        environment=optional(table, "environment", dict, source, {}),
        wall_seconds=number(table.get("wall_seconds"), "wall_seconds", source),
    )


def read_run(folder: Path, protocol: str = "default") -> Run:
    """Read one run folder, with its scores under ``protocol``.

    Raises:
        InputError: the folder is no run, or a file of it is missing or broken; the sentence names it.
    """
    if not folder.is_dir():
        raise InputError(f"There is no run at '{folder}'.", "Give the folder that `invgraphics fit` wrote.")
    source = folder / ("scores.json" if protocol == "default" else f"scores.{protocol}.json")
    scores = read_table(source)
    provenance = read_table(folder / "provenance.json")
    for key in ("truth_sha256", "truth"):
        need(provenance, key, str, folder / "provenance.json")
    views = tuple(str(view) for view in need(scores, "views", list, source))
    quality = read_quality(need(scores, "quality", dict, source), source)
    for name, score in quality.items():
        if score.per_view and len(score.per_view) != len(views):
            raise InputError(f"'{source}': '{name}' has {len(score.per_view)} values for {len(views)} views.")
    cost = need(scores, "cost", dict, source)
    return Run(
        folder=folder,
        method=need(scores, "method", str, source),
        seed=need(scores, "seed", int, source),
        preset=optional(scores, "preset", str, source, ""),
        scene=optional(scores, "scene", str, source, ""),
        protocol=optional(scores, "protocol", str, source, "default"),
        views=views,
        quality=quality,
        cost={str(key): number(value, key, source) for key, value in cost.items()},
        skipped={str(key): str(why) for key, why in optional(scores, "skipped", dict, source, {}).items()},
        history=read_history(folder / "history.jsonl"),
        provenance=dict(provenance),
        environment=dict(read_table(folder / "environment.json")),
        truth=(folder / str(provenance["truth"])).resolve(),
        disturbed=optional(scores, "disturbed", str, source, ""),
        shortfall=optional(scores, "shortfall", str, source, ""),
    )


def read_quality(table: Table, source: Path) -> dict[str, Score]:
    """The ``quality`` part of a score file."""
    scores = {}
    for name, entry in table.items():
        if not isinstance(entry, Mapping):
            raise InputError(f"'{source}': the metric '{name}' must be a table, not {entry!r}.")
        scores[str(name)] = Score(
            mean=number(need(entry, "mean", object, source), name, source),
            unit=optional(entry, "unit", str, source, ""),
            higher_is_better=need(entry, "higher_is_better", bool, source),
            per_view=tuple(number(value, name, source) for value in optional(entry, "per_view", list, source, [])),
        )
    return scores


def read_history(path: Path) -> tuple[Progress, ...]:
    """A run's history; a last line cut off by a kill is dropped, as the fit itself would on resuming."""
    lines = _guarded(path, lambda: path.read_text(encoding="utf-8")).splitlines()
    entries = []
    for position, line in enumerate(lines):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError as error:
            if position == len(lines) - 1:
                break
            raise InputError(f"'{path}', line {position + 1}, is not valid JSON: {error.msg}.") from None
        if not isinstance(entry, dict):
            raise InputError(f"'{path}', line {position + 1}, must be a table.")
        seconds = number(need(entry, "seconds", object, path), "seconds", path)
        if seconds is not None:
            psnr, share, dead = (number(entry.get(key), key, path) for key in ("psnr", "progress", "dead"))
            broken = tuple(key for key, value in entry.items() if isinstance(value, float) and not math.isfinite(value))
            entries.append(Progress(need(entry, "step", int, path), seconds, psnr, share, dead, broken))
    return tuple(entries)


def check_comparable(runs: tuple[Run, ...]) -> None:
    """Refuse runs that were not scored against the same pixels in the same way.

    Raises:
        InputError: ground truth, test views, background or protocol differ; the sentence names both runs.
    """
    for run in runs[1:]:
        first = runs[0]
        backgrounds = [one.provenance.get("background") for one in (first, run)]
        facts: tuple[tuple[str, Any, Any], ...] = (
            ("ground truth", first.truth_hash[:12], run.truth_hash[:12]),
            ("test views", len(first.views), len(run.views)),
            ("backgrounds", backgrounds[0], backgrounds[1]),
            ("protocol", first.protocol, run.protocol),
        )
        equal = (
            first.truth_hash == run.truth_hash,
            first.views == run.views,
            backgrounds[0] == backgrounds[1],
            first.protocol == run.protocol,
        )
        for (what, left, right), same in zip(facts, equal, strict=True):
            if not same:
                raise InputError(
                    f"'{first.folder}' and '{run.folder}' were scored against different {what} ({left} and {right}).",
                    "Compare runs of one scene at one size, with the same test views and protocol.",
                )


def read_table(path: Path) -> dict[str, Any]:
    """A JSON file that holds a table."""
    text = _guarded(path, lambda: path.read_text(encoding="utf-8"))
    try:
        table = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"'{path}' is not valid JSON (line {error.lineno}, column {error.colno}: {error.msg}).") from None
    if not isinstance(table, dict):
        raise InputError(f"'{path}' must hold a table, not a {type(table).__name__}.")
    return table


def need(table: Any, key: str, kind: type[T], source: Path) -> T:
    """``table[key]``, which must be a ``kind``."""
    if not isinstance(table, Mapping) or key not in table:
        raise InputError(f"'{source}' lacks the key '{key}'.")
    value = table[key]
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise InputError(f"'{source}': '{key}' cannot be {value!r}.")
    return value


def optional(table: Table, key: str, kind: type[T], source: Path, default: T) -> T:
    """``table[key]``, or ``default`` where it is absent or null."""
    return default if table.get(key) is None else need(table, key, kind, source)


def number(value: Any, key: str, source: Path) -> float | None:
    """A number as a float; null and NaN are ``None``, infinity (a perfect PSNR) stays."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"'{source}': '{key}' cannot be {value!r}.", "Expected: a number.")
    return None if math.isnan(value) else float(value)


def _guarded(path: Path, read: Callable[[], str]) -> str:
    try:
        return read()
    except FileNotFoundError:
        raise InputError(f"'{path}' is missing.", "The run may have been killed before it was scored.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"'{path}' cannot be read: {error}.") from None
