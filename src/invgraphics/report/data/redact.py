"""Redaction of public reports: removes absolute paths, user names, host names and picture metadata."""

from __future__ import annotations

import contextlib
import getpass
import json
import re
import socket
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

from invgraphics.errors import InputError
from invgraphics.files import write_picture, write_text
from invgraphics.report.data.pictures import read_picture
from invgraphics.tables import LIMITS, read_json, read_text

T = TypeVar("T")

HIDDEN = "…"
"""Stands where a private word was."""

HOMES = re.compile(r"(?:/home/|/Users/|/var/home/|[A-Za-z]:\\+Users\\+)([^/\\\s'\"]+)")
WINDOWS = re.compile(r"[A-Za-z]:\\[^\s'\",;]*")
QUOTED = re.compile(r"(['\"])((?:file://)?(?:~[\w.-]*)?/(?!/)[^'\"]*|[A-Za-z]:\\[^'\"]*)\1")
INSIDE = r"[^\s'\",;:()\[\]{}<>|/]"
POSIX = re.compile(rf"(?:file://|(?<![\w./~…])(?:~[\w.-]*)?(?=/(?!/)))/(?:{INSIDE}|/)+")

GENERIC_NAMES = {
    "root",
    "user",
    "ubuntu",
    "admin",
    "runner",
    "nobody",
    "localhost",
    "docker",
    "shared",
    "public",
    "jovyan",
    "app",
}
"""Names that identify no one, and that are words of ordinary sentences."""

PRIVATE_KEYS = {"host", "hostname", "node", "user", "username", "login", "home", "cwd", "email"}
"""Keys of a record whose values are private whatever they are."""

SHORTEST = 3
"""Shorter names are not looked for: they are parts of ordinary words' notation, and a path never shows them."""


@dataclass(frozen=True)
class Redactor:
    """Removes user names, host names and absolute paths from all outputs of a report.

    Attributes:
        words: user and host names, matched as whole words whatever their case.
        paths: absolute paths that some record holds as a whole; elsewhere their spaces would hide where they end.
        names: path -> what replaces it, where the last component would not tell it from another.
    """

    words: tuple[str, ...]
    paths: tuple[str, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)

    def text(self, text: str) -> str:
        """Redact a text: absolute paths become their last component, private words an ellipsis."""
        text = QUOTED.sub(lambda match: f"{match[1]}{self._last(match[2])}{match[1]}", text)
        for path in self.paths:
            text = re.sub(rf"{re.escape(path)}(?:/{INSIDE}*)*(?!\w)", lambda match: self._last(match[0]), text)
        text = POSIX.sub(lambda match: self._last(match[0]), text)
        text = WINDOWS.sub(lambda match: self._last(match[0]), text)
        for word in self.words:
            text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(word)}(?![A-Za-z0-9])", HIDDEN, text, flags=re.IGNORECASE)
        return text

    def value(self, value: T) -> T:
        """Redact strings inside tables, sequences and records; numbers, folders and keys stay."""
        result: Any = value
        if isinstance(value, str):
            result = self.text(value)
        elif isinstance(value, Mapping):
            kept = {key: item for key, item in value.items() if str(key).lower() not in PRIVATE_KEYS}
            result = {self.value(key): self.value(item) for key, item in kept.items()}
        elif isinstance(value, list | tuple):
            result = type(value)(self.value(item) for item in value)  # type: ignore[call-arg]
        elif is_dataclass(value) and not isinstance(value, type):
            result = replace(value, **{item.name: self.value(getattr(value, item.name)) for item in fields(value)})
        return result

    def copy(self, source: Path, target: Path) -> None:
        """Write a clean copy: JSON value by value, other text line by line, pictures as bare pixels."""
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".png":
            from PIL import Image

            write_picture(target, Image.fromarray(read_picture(source)), optimize=True)
        elif source.suffix == ".json":
            write_text(target, json.dumps(self.value(read_json(source)), indent=1) + "\n")
        else:
            write_text(target, self.text(read_text(source, LIMITS.json_bytes)))

    def _last(self, path: str) -> str:
        """The last component of an absolute path, unless it is a home or a private word, or has a name of its own."""
        if path in self.names:
            return self.names[path]
        windows = "\\" in path
        parts = list(PureWindowsPath(path).parts if windows else [part for part in path.split("/") if part])
        last = parts[-1] if parts else ""
        above = parts[-2].lower() if len(parts) > 1 else ""
        private = not last or last.startswith("~") or above in ("home", "users") or last.lower() in self._lowered
        return HIDDEN if private else last

    @property
    def _lowered(self) -> set[str]:
        return {word.lower() for word in self.words}


def redactor_for(records: Iterable[Any], scenes: Sequence[str] = ()) -> Redactor:
    """Redactor of this machine's user and host, and of names from home folders and private keys in ``records``.

    Args:
        records: what the report is made of.
        scenes: of the report; different ones whose paths end alike are numbered, since tables and statistics go by them.
    """
    found = {socket.gethostname(), socket.gethostname().partition(".")[0], Path.home().name}
    with contextlib.suppress(KeyError, OSError):  # some containers' users have no name
        found.add(getpass.getuser())
    for record in records:
        _gather(record, found)
    names = {name for name in found if len(name) >= SHORTEST and name.lower() not in GENERIC_NAMES}
    whole = {name for name in found if _is_path(name)}
    words, paths = (tuple(sorted(group, key=lambda name: (-len(name), name))) for group in (names - whole, whole))
    redactor = Redactor(words, paths)
    return replace(redactor, names=_numbered(scenes, redactor))


def _numbered(scenes: Sequence[str], redactor: Redactor) -> dict[str, str]:
    """Numbered names of the scenes after the first whose redacted names are equal."""
    names: dict[str, str] = {}
    seen: Counter[str] = Counter()
    for scene in dict.fromkeys(scenes):
        name = redactor.text(scene)
        seen[name] += 1
        if seen[name] > 1:
            names[scene] = f"{name} ({seen[name]})"
    return names


def _is_path(text: str) -> bool:
    return text.startswith("/") and len(text) > 1 and "\n" not in text


def _gather(value: Any, found: set[str]) -> None:
    if isinstance(value, str | Path):
        found.update([str(value)] if _is_path(str(value)) else [])
        found.update(match[1] for match in HOMES.finditer(str(value)))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            if str(key).lower() in PRIVATE_KEYS and isinstance(item, str) and not _is_path(item):
                parts = [part for part in re.split(r"[/\\@\s]+", item) if part]
                found.update([*parts, *(part.partition(".")[0] for part in parts)])
            _gather(item, found)
    elif isinstance(value, list | tuple):
        for item in value:
            _gather(item, found)
    elif is_dataclass(value) and not isinstance(value, type):
        for item in fields(value):
            _gather(getattr(value, item.name), found)


def check_runs_outside(out: Path, runs: Iterable[Path]) -> None:
    """Refuse a public report whose folder would contain the runs themselves, which hold paths and names.

    Raises:
        InputError: a run lies inside ``out``.
    """
    if any(run.resolve().is_relative_to(out.resolve()) for run in runs):
        remedy = "Give a new folder with --out."
        raise InputError(f"A public report cannot be written to '{out}', because private runs lie in it.", remedy)
