"""Records: frozen dataclasses stored as JSON files of a public format, validated on reading, written atomically.

A field without a default is a key that every file has. For another, absence and null stand for the default, and a default that
says nothing (null, empty, false) is left out. Keys that a reader does not know are ignored, so that keys can be added; what
readers must not overlook raises the record's ``SCHEMA``, and `Record.migrate` brings older tables up to date. `Record.RENAMED`
lists keys that had another name.
"""

from __future__ import annotations

import dataclasses
import json
import math
import reprlib
import types
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin, get_type_hints

from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.tables import read_json

T = TypeVar("T")

NOT_STORED = {"stored": False}
"""Metadata of a field that is no key of the file."""
_KILLED = "The run may have been killed before it was written."
_LARGEST = 1e100
"""Largest finite number of a record: sums, products and ratios of what is read stay finite."""


@dataclass(frozen=True)
class Record:
    """A JSON file of a run, comparison or study folder."""

    SCHEMA: ClassVar[int] = 1
    """Version of the format that is written; files without the key ``schema`` have version 1."""
    FILE: ClassVar[str] = ""
    """Name of the file in its folder; empty where the name depends on the content, see `file`."""
    RENAMED: ClassVar[Mapping[str, str]] = {}
    """Dotted path of a key in files of earlier versions -> the key's name today."""

    @property
    def file(self) -> str:
        """Name of the file that holds this record."""
        return self.FILE

    @classmethod
    def migrate(cls, table: dict[str, Any], schema: int) -> dict[str, Any]:
        """Convert a table of an older ``schema`` to ``schema + 1``."""
        return table

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a record from its file, validated and migrated.

        Raises:
            InputError: it is missing, is no JSON table, lacks a key, has a value of the wrong type or a newer schema; the
                sentence names file and key.
        """
        return from_table(cls, read_table(path), path)

    def to_table(self) -> dict[str, Any]:
        """Convert the record to plain JSON values, as in its file."""
        return plain(self)

    def write(self, path: Path) -> None:
        """Write the record atomically: an interruption leaves either the old file or the new one, a loss of power included."""
        write_json(path, self.to_table(), durable=True)


def stored_fields(kind: type) -> dict[str, bool]:
    """Map the keys of a record or of a table in it, in their order in the file, to whether they are required."""
    fields = (field for field in dataclasses.fields(kind) if field.metadata.get("stored", True))
    return {field.name: not _has_default(field) for field in fields}


def plain(value: Any) -> Any:
    """Convert a value to plain JSON values: records become tables without empty defaults, tuples become lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        table = {"schema": value.SCHEMA} if isinstance(value, Record) else {}
        for field in dataclasses.fields(value):
            item = getattr(value, field.name)
            if field.metadata.get("stored", True) and not _is_empty_default(field, item):
                table[field.name] = plain(item)
        return table
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def from_table(kind: type[T], table: Any, source: Path, key: str = "") -> T:
    """Make a ``kind``, a record or a table in one, from plain values.

    Args:
        kind: a frozen dataclass.
        table: what the file holds at ``key``.
        source: the file, for messages.
        key: dotted path of the table in the file; empty for the whole file.

    Raises:
        InputError: a key is missing, a value has the wrong type or is refused by ``kind``, or the schema is newer; the sentence
            names file and key.
    """
    if not isinstance(table, Mapping):
        raise _wrong(source, key, table, "a table")
    if issubclass(kind, Record):
        table = _current(kind, table, source, key)
    hints, values = _hints(kind), {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if not field.metadata.get("stored", True):
            continue
        path, optional = _join(key, field.name), _has_default(field)
        if not optional and field.name not in table:
            raise InputError(f"'{source}' lacks the key '{path}'.", f"Expected: {_described(hints[field.name])}.")
        if not optional or table.get(field.name) is not None:
            values[field.name] = _converted(hints[field.name], table[field.name], source, path)
    try:
        return kind(**values)
    except ValueError as error:  # a record's own check of its values
        where = f"'{source}', key '{key}'" if key else f"'{source}'"
        raise InputError(f"{where}: {error}") from error


def read_table(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds a table, within the limits of `invgraphics.tables`.

    Raises:
        InputError: it is missing, unreadable or holds no table.
    """
    if not path.exists():
        raise InputError(f"'{path}' is missing.", _KILLED)
    table = read_json(path)
    if not isinstance(table, dict):
        raise InputError(f"'{path}' must hold a table, not a {type(table).__name__}.")
    return table


def write_json(path: Path, content: Any, *, durable: bool = False) -> None:
    """Write JSON atomically; ``durable`` as of `invgraphics.files.writing`."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n", durable=durable)


def _current(kind: type[Record], table: Mapping[str, Any], source: Path, key: str) -> Mapping[str, Any]:
    """Migrate a table to the schema and the key names of this version."""
    schema = table.get("schema", 1)
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise _wrong(source, _join(key, "schema"), schema, "a whole number, 1 or more")
    if schema > kind.SCHEMA:
        where = f"'{source}'" if not key else f"'{source}', '{key}',"
        raise InputError(
            f"{where} has schema {schema}, and this version of invgraphics reads schema {kind.SCHEMA} and older.",
            "Install the version that wrote it, or a newer one.",
        )
    for older in range(schema, kind.SCHEMA):
        table = kind.migrate(dict(table), older)
    for path, name in kind.RENAMED.items():
        table = _rename(table, path.split("."), name)
    return table


def _rename(table: Mapping[str, Any], path: list[str], name: str) -> Mapping[str, Any]:
    """Copy of ``table`` in which the key at ``path`` is called ``name``; unchanged without that key, or with both."""
    old = path[0]
    if len(path) > 1:
        inner = table.get(old)
        return {**table, old: _rename(inner, path[1:], name)} if isinstance(inner, Mapping) else table
    if old not in table or name in table:
        return table
    return {name if key == old else key: value for key, value in table.items()}


def _converted(hint: Any, value: Any, source: Path, key: str) -> Any:
    """Convert ``value`` to the type that ``hint`` names."""
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        return _one_of(args, value, source, key)
    if origin is Literal:
        if value in args:
            return value
    elif origin is tuple and isinstance(value, list):
        kinds = [args[0]] * len(value) if args[1:] == (...,) else args
        if len(kinds) == len(value):
            pairs = enumerate(zip(kinds, value, strict=True))
            return tuple(_converted(kind, item, source, f"{key}.{index}") for index, (kind, item) in pairs)
    elif origin is dict and isinstance(value, Mapping):
        return {str(name): _converted(args[1], item, source, _join(key, str(name))) for name, item in value.items()}
    elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return from_table(hint, value, source, key)
    elif hint is float and _is_number(value) and (abs(value) <= _LARGEST or abs(value) == math.inf):
        return float(value)
    elif hint is int and _is_number(value) and float(value).is_integer() and abs(value) < 2**63:
        return int(value)
    elif hint in (str, bool) and type(value) is hint:
        return value
    raise _wrong(source, key, value, _described(hint))


def _one_of(options: tuple[Any, ...], value: Any, source: Path, key: str) -> Any:
    """Convert ``value`` to the first member of a union that accepts it; NaN counts as missing for optional numbers."""
    missing = value is None or (float in options and isinstance(value, float) and math.isnan(value))
    if missing and type(None) in options:
        return None
    kinds = [option for option in options if option is not type(None)]
    for kind in kinds[:-1]:
        try:
            return _converted(kind, value, source, key)
        except InputError:
            continue
    return _converted(kinds[-1], value, source, key)


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**1000)


def _wrong(source: Path, key: str, value: Any, expected: str) -> InputError:
    return InputError(f"'{source}': '{key}' cannot be {reprlib.repr(value)}.", f"Expected: {expected}.")


def _described(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(repr(arg) for arg in args)
    if origin in (Union, types.UnionType):
        return " or ".join("null" if arg is type(None) else _described(arg) for arg in args)
    if origin is tuple:
        return "a list, each entry " + _described(args[0])
    names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", Any: "any value"}
    return names.get(hint, "a table")


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _is_empty_default(field: dataclasses.Field[Any], value: Any) -> bool:
    """Whether a value is the field's default, and null, empty or false."""
    if not _has_default(field):
        return False
    default = field.default if field.default is not dataclasses.MISSING else field.default_factory()  # type: ignore[misc]
    return value == default and (not value or dataclasses.is_dataclass(value))
