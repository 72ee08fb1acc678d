"""``history.jsonl``: the training history of a fit, one JSON table a line, appended while it runs."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.files import append_text, write_text
from invgraphics.runs.schema import NOT_STORED, from_table, plain
from invgraphics.tables import LIMITS, parse_json, read_text

FILE = "history.jsonl"


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One line of a run's history.

    Attributes:
        step: optimisation steps taken.
        seconds: time spent in optimisation, nothing else.
        progress: share of the budget that is spent, in [0, 1]; ``None`` where it is not known.
        psnr: on a fixed set of pixels of views that are not trained on, dB; ``None`` where it was not measured.
        loss: of the last step.
        primitives: how many there are.
        dead: share of them that no gradient can change.
        not_finite: keys of the line whose value is NaN or infinite.
    """

    step: int
    seconds: float
    progress: float | None = None
    psnr: float | None = None
    loss: float | None = None
    primitives: int | None = None
    dead: float | None = None
    not_finite: tuple[str, ...] = field(default=(), metadata=NOT_STORED)


def read_history(path: Path) -> tuple[Moment, ...]:
    """Read all moments, oldest first; a last line truncated by an interruption is dropped, as on resuming.

    Raises:
        InputError: the file is missing, or another line is broken; the sentence names it.
    """
    moments = []
    for table in _tables(path):
        not_finite = tuple(key for key, value in table.items() if isinstance(value, float) and not math.isfinite(value))
        if table.get("seconds", 0) is not None:
            moments.append(replace(from_table(Moment, table, path), not_finite=not_finite))
    return tuple(moments)


def append_history(path: Path, moment: Moment) -> None:
    """Append one moment as a line."""
    append_text(path, json.dumps(plain(moment)) + "\n")


def cut_history(path: Path, step: int) -> None:
    """Truncate the history after ``step``, from which a resumed fit continues."""
    if path.is_file():
        kept = [table for table in _tables(path) if table["step"] <= step]
        write_text(path, "".join(json.dumps(table) + "\n" for table in kept))


def _tables(path: Path) -> Iterator[dict[str, Any]]:
    if not path.exists():
        raise InputError(f"'{path}' is missing.", "The run may have been killed before it was written.")
    lines = read_text(path, LIMITS.json_bytes).splitlines()
    for number, line in enumerate(lines, 1):
        try:
            table = parse_json(line, f"'{path}', line {number},")
        except InputError:
            if number == len(lines):
                return
            raise
        step = table.get("step") if isinstance(table, dict) else None
        if isinstance(step, bool) or not isinstance(step, int | float):
            raise InputError(f"'{path}', line {number}, is no table with the key 'step', a number.")
        yield table
