"""Text helpers: names of folders and files, durations, hashes of plain values."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from typing import Any


def slug(method: str) -> str:
    """Convert a method's name, ``renderer/recipe`` or the path of a recipe, to one folder name."""
    return method.removesuffix(".toml").strip("/").replace("/", "-").replace(":", "-")


def file_name(key: str) -> str:
    """Convert a name to a part of a file name: letters and digits stay, all else becomes a hyphen."""
    return "".join(letter if letter.isalnum() else "-" for letter in key)


def common_value(texts: Sequence[str]) -> str:
    """The value that all texts share; empty where they differ, or there is none."""
    return texts[0] if len(set(texts)) == 1 else ""


def name_lines(name: str, letters: int, most: int = 4) -> list[str]:
    """Break a method's name into at most ``most`` lines of at most ``letters`` each, after slashes, colons and blanks.

    Only what is longer than a line breaks after dots, or anywhere. What does not fit is left out, and an ellipsis says so.
    """
    lines = [""]
    for word in re.findall(r"[^/: ]*[/: ]|[^/: ]+", name):
        parts = [word] if len(word.rstrip()) <= letters else re.findall(rf"[^.]{{0,{letters - 1}}}\.|[^.]{{1,{letters}}}", word)
        for part in parts:
            if len(lines[-1] + part.rstrip()) > letters:
                lines.append("")
            lines[-1] += part
    lines = [line.strip() for line in lines]
    return lines if len(lines) <= most else [*lines[: most - 1], lines[most - 1][: letters - 1] + "…"]


def duration(seconds: float) -> str:
    """Format a duration: ``12 s``, ``6 min 52 s``, ``10 min``, ``2 h 1 min``."""
    if seconds < 90 or seconds == float("inf"):
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "h"), (minutes, "min")) if hours else ((minutes, "min"), (rest, "s"))
    return " ".join(f"{amount} {unit}" for amount, unit in parts if amount)


def sha256_of(value: Any) -> str:
    """SHA-256 (hex) of plain values: of their JSON with sorted keys, so that the order of a table does not count."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
