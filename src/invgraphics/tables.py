"""Safe reading of untrusted files: JSON and TOML within limits on size, depth and digits.

What a file may cost is known before it is read: sizes are compared with `LIMITS`. Typed records are made of the
plain values (`invgraphics.config.fill`).
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.memory import format_bytes


@dataclass(frozen=True)
class Limits:
    """Limits on the size, depth and digits of files.

    Attributes:
        json_bytes: length of a JSON file; a thousand posed photographs take about 1 MB.
        toml_bytes: length of a TOML file.
        depth: of tables and lists within each other, and parts of a dotted TOML key.
        digits: of a whole number; 64 bits need 20.
    """

    json_bytes: int = 64 << 20
    toml_bytes: int = 1 << 20
    depth: int = 64
    digits: int = 20


LIMITS = Limits()

_KEY_PARTS = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{LIMITS.depth}}}")
"""A dotted key of too many parts, for which tomllib takes quadratic time and memory."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
"""An escape of half a character beyond the basic plane, in JSON."""


def read_json(path: Path) -> Any:
    """Read a JSON file (UTF-8).

    Raises:
        InputError: it is missing, unreadable, no JSON (line and column are given), or beyond `LIMITS`.
    """
    return parse_json(read_text(path, LIMITS.json_bytes), str(path))


def parse_json(text: str, where: str) -> Any:
    """Parse JSON to plain values; ``where`` names its origin in messages.

    Raises:
        InputError: it is no JSON (line and column are given), or beyond `LIMITS`.
    """
    try:
        value = json.loads(text, parse_int=_whole)
        _check_depth(value)
        if _SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()  # half a pair of surrogates could never be written again
    except json.JSONDecodeError as error:
        raise InputError(f"{where} is not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}.") from error
    except ValueError as error:
        raise InputError(f"{where} is not JSON that can be used: {error}.") from error
    except RecursionError:
        raise InputError(f"{where} is not JSON that can be used: {_TOO_DEEP}.") from None
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file (UTF-8).

    Raises:
        InputError: it is missing, unreadable, no TOML, or beyond `LIMITS`.
    """
    return parse_toml(read_text(path, LIMITS.toml_bytes), str(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Parse TOML to plain values; ``where`` names its origin in messages.

    Raises:
        InputError: it is no TOML, or beyond `LIMITS`.
    """
    try:
        if len(text) > LIMITS.toml_bytes:
            raise ValueError(f"it has {len(text)} characters, more than {LIMITS.toml_bytes}")
        if _KEY_PARTS.search(text):
            raise ValueError(f"a dotted key has more than {LIMITS.depth} parts")
        table = tomllib.loads(text)
        _check_depth(table, whole=True)
    except ValueError as error:  # TOMLDecodeError is one
        raise InputError(f"{where} is not valid TOML: {str(error).rstrip('.')}.") from error
    except RecursionError:
        raise InputError(f"{where} is not valid TOML: {_TOO_DEEP}.") from None
    return table


def inline_toml(value: Any) -> str:
    """Format a value as TOML on one line, tables within braces (inverse of `parse_toml`); numpy's values as plain ones.

    Raises:
        ValueError: TOML has no such value.
    """
    import tomlkit  # here, as listing needs none

    table = tomlkit.inline_table()  # within which lists of tables are inline too
    table["value"] = plain(value)
    return table.as_string().removeprefix("{value = ").removesuffix("}")


def plain(value: Any) -> Any:
    """Convert numpy scalars and arrays, tensors and paths within tables and lists to the plain values that TOML has.

    Raises:
        ValueError: TOML has no such value.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if callable(getattr(value, "tolist", None)):
        value = value.tolist()
    if isinstance(value, list):
        return plain(value)
    if isinstance(value, str | bool | int | float):
        return value
    raise ValueError(f"TOML has no {type(value).__name__}")


def read_text(path: Path, most: int) -> str:
    """Read a UTF-8 text file of at most ``most`` bytes.

    Raises:
        InputError: it is missing, unreadable, no text, or longer.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
        text = data.decode("utf-8-sig")  # with or without a byte-order mark
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8: byte {error.start} is not.") from error
    except (OSError, ValueError) as error:  # a NUL in the path is a ValueError
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    if len(data) > most:
        raise InputError(f"{path} is longer than {format_bytes(most)}, which no file of this kind is.")
    return text


_TOO_DEEP = f"tables and lists lie within each other more than {LIMITS.depth} deep"


def _whole(digits: str) -> int:
    """Parse a JSON integer, within the limit on digits."""
    if len(digits) > LIMITS.digits:
        raise ValueError(f"a whole number has {len(digits)} digits")
    return int(digits)


def _check_depth(value: Any, whole: bool = False) -> None:
    """Refuse values nested beyond `LIMITS`, and, if ``whole``, whole numbers of too many digits."""
    level: list[Any] = [[value]]
    for _ in range(LIMITS.depth + 2):
        inner = [item for each in level for item in (each.values() if isinstance(each, dict) else each)] if level else []
        if whole and any(isinstance(item, int) and abs(item) >= 10**LIMITS.digits for item in inner):
            raise ValueError(f"a whole number has more than {LIMITS.digits} digits")
        level = [item for item in inner if isinstance(item, dict | list)]
        if not level:
            return
    raise ValueError(_TOO_DEEP)
