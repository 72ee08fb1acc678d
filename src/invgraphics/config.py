"""Typed settings: frozen dataclasses are the schema, a TOML table fills them, unknown keys are refused.

A polymorphic place in a schema is an ``Annotated[Any, Slot("encodings")]``: its table carries a ``type`` key that names an
entry of that registry, whose value is the frozen dataclass for the rest of the table. The dotted path of a value in the
filled tree is its ``--set`` key and its name as a study's factor.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from invgraphics import plugins
from invgraphics.errors import InputError, did_you_mean

T = TypeVar("T")

OMIT_EMPTY = {"omit_empty": True}
"""Metadata of a field that is left out of tables where it is empty, so that tables without it stay as they were."""

BUILT = ("fields", "encodings", "renderers", "samplers", "hooks")
"""Registries whose configs build something; those of the others are the thing itself."""


@dataclass(frozen=True)
class Slot:
    """Marks a polymorphic value: one of a registry's entries, chosen by the table's ``type`` key."""

    registry: str


def fill(schema: type[T], table: Mapping[str, Any], path: str = "") -> T:
    """Fill the dataclass ``schema`` from ``table``.

    Args:
        schema: a frozen dataclass.
        table: plain values as TOML gives them.
        path: dotted path of the table, for messages.

    Raises:
        InputError: a key is unknown, missing or of the wrong type; the sentence names its dotted path.
    """
    hints = _hints(schema)
    fields = {field.name: field for field in dataclasses.fields(schema) if field.init}  # type: ignore[arg-type]
    for key in table:
        if key not in fields:
            known = ", ".join(fields) or "none: this part has no settings"
            raise InputError(f"Unknown key '{_join(path, key)}'.{did_you_mean(key, fields)}", f"Known keys here: {known}.")
    values = {key: _convert(hints[key], value, _join(path, key)) for key, value in table.items()}
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in values:
            raise InputError(f"The key '{_join(path, name)}' is missing.", f"Expected: {_describe(hints[name])}.")
    try:
        return schema(**values)
    except ValueError as error:
        raise InputError(f"'{path or schema.__name__}': {error}") from error


@cache
def _hints(schema: type) -> dict[str, Any]:
    """Types of a dataclass's fields, whose annotations are evaluated once."""
    return get_type_hints(schema, include_extras=True)


def fill_slot(registry: str, table: Mapping[str, Any], path: str) -> Any:
    """Fill the registered config that ``table['type']`` names from the rest of the table."""
    if not isinstance(table, Mapping) or "type" not in table:
        known = ", ".join(sorted(plugins.names(registry)))
        raise InputError(f"'{path}' needs a 'type' key.", f"{path}.type names one of the {registry}: {known}.")
    rest = {key: value for key, value in table.items() if key != "type"}
    schema = plugins.load(registry, str(table["type"]))
    if not (isinstance(schema, type) and dataclasses.is_dataclass(schema)):
        raise InputError(f"'{table['type']}' of the {registry} is {schema!r}, no dataclass.", "See docs/extending.md.")
    if registry in BUILT and not callable(getattr(schema, "build", None)):
        raise InputError(
            f"'{table['type']}' of the {registry}, {schema.__name__}, has no method 'build'.", "See docs/extending.md."
        )
    return fill(schema, rest, path)


def to_table(config: Any) -> dict[str, Any]:
    """Convert a config to its complete table (inverse of `fill`), with defaults, without ``None`` (see `OMIT_EMPTY`)."""
    hints = _hints(type(config))
    table = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        omitted = field.metadata.get("omit_empty", False) and not value
        if value is not None and field.init and not omitted:
            table[field.name] = _plain(hints[field.name], value)
    return table


def set_path(table: dict[str, Any], path: str, value: Any) -> None:
    """Set ``table[a][b][c] = value`` for ``path = "a.b.c"``; list entries are addressed by number.

    Setting a part's ``type`` to another one drops the settings of the old.
    """
    *parents, last = path.split(".")
    node: Any = table
    for depth, key in enumerate(parents):
        try:
            node = node[int(key)] if isinstance(node, list) else node.setdefault(key, {})
        except (ValueError, IndexError, AttributeError):
            raise InputError(f"Unknown key '{path}': there is no '{'.'.join(parents[: depth + 1])}'.") from None
    if isinstance(node, list):
        if not last.isdigit() or int(last) >= len(node):
            raise InputError(f"Unknown key '{path}': '{'.'.join(parents)}' has entries 0 to {len(node) - 1}.")
        node[int(last)] = value
    elif isinstance(node, dict):
        if last == "type" and node.get("type") != value:
            node.clear()  # another type has other settings
        node[last] = value
    else:
        raise InputError(f"Unknown key '{path}': '{'.'.join(parents)}' is a value, not a table.")


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge ``over`` into ``base``, tables key by key. A table whose ``type`` changes is replaced whole."""
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        same_type = (
            isinstance(value, Mapping) and isinstance(old, Mapping) and value.get("type", old.get("type")) == old.get("type")
        )
        result[key] = merge(old, value) if same_type and isinstance(old, Mapping) else value
    return result


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _slot_of(hint: Any) -> Slot | None:
    if get_origin(hint) is Annotated:
        return next((extra for extra in get_args(hint)[1:] if isinstance(extra, Slot)), None)
    return None


def _convert(hint: Any, value: Any, path: str) -> Any:
    slot = _slot_of(hint)
    if slot is not None:
        return fill_slot(slot.registry, value, path)
    origin, args, guess = get_origin(hint), get_args(hint), ""
    if origin is Annotated:
        return _convert(args[0], value, path)
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, path)
    if origin is Literal:
        if value in args:
            return value
        guess = did_you_mean(value, [arg for arg in args if isinstance(arg, str)]) if isinstance(value, str) else ""
    elif origin is tuple and isinstance(value, list | tuple):
        if len(args) == 2 and args[1] is ...:
            return tuple(_convert(args[0], item, f"{path}.{i}") for i, item in enumerate(value))
        if len(args) == len(value):
            return tuple(_convert(arg, item, f"{path}.{i}") for i, (arg, item) in enumerate(zip(args, value, strict=True)))
    elif origin is dict and isinstance(value, Mapping):
        return {str(key): _convert(args[1], item, _join(path, str(key))) for key, item in value.items()}
    elif dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if isinstance(value, Mapping):
            return fill(hint, value, path)
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    elif (hint is Any) or (hint in (int, str, bool) and type(value) is hint):
        return value
    raise InputError(f"'{path}' cannot be {value!r}.{guess}", f"Expected: {_describe(hint)}.")


def _convert_union(args: tuple[Any, ...], value: Any, path: str) -> Any:
    options = [arg for arg in args if arg is not type(None)]
    if value is None and len(options) < len(args):
        return None
    failure: InputError | None = None
    for option in options:
        try:
            return _convert(option, value, path)
        except InputError as error:
            failure = failure or error
    raise failure or InputError(f"'{path}' cannot be {value!r}.")


def _plain(hint: Any, value: Any) -> Any:
    slot = _slot_of(hint)
    if slot is not None:
        return {"type": plugins.name_of(slot.registry, type(value)), **to_table(value)}
    if get_origin(hint) in (Union, types.UnionType):
        slots = [arg for arg in get_args(hint) if _slot_of(arg)]
        return _plain(slots[0] if slots else Any, value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_table(value)
    if isinstance(value, dict):
        inner = get_args(hint)[1] if get_args(hint) else Any
        return {key: _plain(inner, item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        inner = get_args(hint)[0] if get_args(hint) else Any
        return [_plain(inner, item) for item in value]
    return value


def _describe(hint: Any) -> str:
    slot = _slot_of(hint)
    if slot is not None:
        return f"a table with a 'type' among {', '.join(sorted(plugins.names(slot.registry)))}"
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(repr(arg) for arg in args)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(arg) for arg in args if arg is not type(None))
    if origin is tuple:
        return "a list of " + _describe(args[0])
    names = {int: "a whole number", float: "a number", str: "a text in quotes", bool: "true or false"}
    return names.get(hint, "a table" if dataclasses.is_dataclass(hint) else str(hint))
