"""Every setting of a resolved recipe: its dotted key, its value as ``--set`` takes it, and what its class says of it."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, get_args, get_type_hints

from invgraphics.config import to_table
from invgraphics.recipes.recipe import assign
from invgraphics.recipes.schema import Recipe
from invgraphics.tables import inline_toml

NOT_SET = "-"
"""Shown for a setting that has no value; ``--set`` cannot give this one."""
_SAID_APART = ("summary", "paper")
_ATTRIBUTE = re.compile(r" {4}(\w+(?:, \w+)*)(?: \([^)]*\))?: (.*)")


@dataclass(frozen=True)
class Setting:
    """One setting of a recipe.

    Attributes:
        key: its dotted path, entries of lists by number.
        value: as ``--set`` takes it, `NOT_SET` for none; in parentheses where its part is not there, for what it would be.
        meaning: first sentence on it in its class's docstring; empty where there is none.
    """

    key: str
    value: str
    meaning: str


def settings_of(recipe: Recipe) -> list[Setting]:
    """List a recipe's settings in the order of their classes; its summary and paper are left out."""
    return [setting for setting in _settings(recipe, to_table(recipe), "") if setting.key not in _SAID_APART]


def described_attributes(kind: type) -> dict[str, str]:
    """First sentences of the ``Attributes`` section of a class's docstring (Google's style), those of its bases included."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found |= _attributes(inspect.cleandoc(base.__dict__.get("__doc__") or ""))
    return {name: _first_sentence(text) for name, text in found.items()}


def shown(value: Any) -> str:
    """Format a value as ``--set`` takes it: text bare where it is read back as itself, all else as TOML."""
    if value is None:
        return NOT_SET
    if isinstance(value, str):
        table: dict[str, Any] = {}
        assign(table, [f"value={value}"])
        if value and table["value"] == value:
            return value
    try:
        return inline_toml(value)
    except ValueError:
        return str(value)


def _settings(config: Any, table: Mapping[str, Any], path: str) -> Iterator[Setting]:
    """Settings of one part; ``table`` is the same as plain values, which has a ``type`` where the part was chosen by one."""
    meanings = described_attributes(type(config))
    names = [field.name for field in dataclasses.fields(config) if field.init]
    if "type" in table and "type" not in names:
        yield Setting(f"{path}type", shown(table["type"]), _first_sentence(inspect.getdoc(type(config)) or ""))
    for name in names:
        value, plain, key = getattr(config, name), table.get(name), f"{path}{name}"
        parts = _parts(value, plain, key)
        if parts:
            for part, its_table, its_key in parts:
                yield from _settings(part, its_table, f"{its_key}.")
            continue
        yield Setting(key, shown(value if plain is None else plain), meanings.get(name, ""))
        if value is None:
            yield from _absent(config, name, key)


def _parts(value: Any, plain: Any, key: str) -> list[tuple[Any, Mapping[str, Any], str]]:
    """The configs that a value is or holds, with their tables and keys; empty for a plain value."""
    if dataclasses.is_dataclass(value):
        return [(value, plain, key)]
    if isinstance(value, list | tuple):
        items = [(item, plain[index], f"{key}.{index}") for index, item in enumerate(value) if dataclasses.is_dataclass(item)]
        return items if len(items) == len(value) else []
    if isinstance(value, Mapping):
        items = [(item, plain[name], f"{key}.{name}") for name, item in value.items() if dataclasses.is_dataclass(item)]
        return items if len(items) == len(value) else []
    return []


def _absent(config: Any, name: str, key: str) -> Iterator[Setting]:
    """Settings of a part that is not there, with the values that it would begin with, in parentheses."""
    for kind in get_args(get_type_hints(type(config))[name]):
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            try:
                part = kind()
            except TypeError:  # something in it has no default
                continue
            for setting in _settings(part, to_table(part), f"{key}."):
                value = setting.value
                yield dataclasses.replace(setting, value=value if value == NOT_SET or value[0] == "(" else f"({value})")


def _attributes(text: str) -> dict[str, str]:
    """Attribute -> text of a cleaned docstring's section; several before one colon share its text."""
    found: dict[str, str] = {}
    names: list[str] = []
    section = re.search(r"^Attributes:\n((?:(?: .*)?(?:\n|$))+)", text, re.MULTILINE)
    for line in section.group(1).splitlines() if section else []:
        begun = _ATTRIBUTE.fullmatch(line)
        names = begun.group(1).split(", ") if begun else names
        for name in names:
            found[name] = begun.group(2) if begun else f"{found[name]} {line.strip()}"
    return found


def _first_sentence(text: str) -> str:
    paragraph = " ".join(text.split("\n\n", maxsplit=1)[0].split()).replace("``", "")
    return re.split(r"(?<=\.)(?<!\bal\.)\s+(?=[A-Z`'\d])", paragraph)[0]
