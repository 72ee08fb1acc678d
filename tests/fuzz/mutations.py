"""Ways to damage a file, byte by byte or knowing its format; every choice is asked of a `Choose`, so that it can be shrunk."""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

T = TypeVar("T")


class Choose(Protocol):
    """Where decisions come from."""

    def index(self, count: int) -> int:
        """One of 0 .. count - 1."""
        ...


def pick(choose: Choose, items: Sequence[T]) -> T:
    """One of ``items``."""
    return items[choose.index(len(items))]


NUMBERS = (0.0, -1.0, 1e-300, 1e-30, -1e30, 1e30, 1e300, math.inf, -math.inf, math.nan, 0.5, 65536.0, 2.0**53)
WORDS = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 64) - 1, 0x7FF0000000000000, 20_000)
VALUES = (
    None,
    True,
    -1,
    0,
    10**400,
    10**25,
    1e300,
    -1e-300,
    math.nan,
    math.inf,
    "",
    "/",
    "\0",
    "word",
    "x" * 5000,
    [],
    {},
    [[]],
)
TOKENS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e300",
    "1e30",
    "1e-30",
    "9" * 400,
    "",
    "word",
    "'",
    '"',
    "[",
    "]",
    "{}",
    "\0",
    "=",
    "\n",
    "é",
)


def flip(data: bytes, choose: Choose) -> bytes:
    """One bit."""
    result = bytearray(data)
    bit = choose.index(8 * len(data))
    result[bit // 8] ^= 1 << bit % 8
    return bytes(result)


def cut(data: bytes, choose: Choose) -> bytes:
    """The beginning only."""
    return data[: choose.index(len(data))]


def drop(data: bytes, choose: Choose) -> bytes:
    """All but a few bytes somewhere."""
    start = choose.index(len(data))
    return data[:start] + data[start + 1 + choose.index(64) :]


def repeat(data: bytes, choose: Choose) -> bytes:
    """A part twice."""
    start = choose.index(len(data))
    end = start + 1 + choose.index(64)
    return data[:end] + data[start:end] + data[end:]


def word(data: bytes, choose: Choose) -> bytes:
    """Four or eight bytes as another integer."""
    form = pick(choose, ("<I", "<Q"))
    return _over(data, choose, struct.pack(form, pick(choose, WORDS) & ((1 << 8 * struct.calcsize(form)) - 1)))


def number(data: bytes, choose: Choose) -> bytes:
    """Four or eight bytes as another floating-point number."""
    with np.errstate(over="ignore"):
        value = np.array(pick(choose, NUMBERS)).astype(pick(choose, ("<f4", "<f8")))
    return _over(data, choose, value.tobytes())


def token(data: bytes, choose: Choose) -> bytes:
    """A word or a number of a text as another one."""
    spans = [match.span() for match in re.finditer(rb"[\w.+-]+|[^\w\s]", data)]
    if not spans:
        return data
    start, end = pick(choose, spans)
    return data[:start] + pick(choose, TOKENS).encode() + data[end:]


def nest(data: bytes, choose: Choose) -> bytes:
    """A value of a text deep within brackets."""
    spans = [match.span() for match in re.finditer(rb"[\d.e+-]+", data)]
    if not spans:
        return data
    start, end = pick(choose, spans)
    depth = pick(choose, (10, 100, 5000))
    return data[:start] + b"[" * depth + data[start:end] + b"]" * depth + data[end:]


def json_value(data: bytes, choose: Choose) -> bytes:
    """One value of a JSON file as another one, or none."""
    table = json.loads(data)
    places = list(_places(table))
    parent, key = pick(choose, places)
    if choose.index(len(VALUES) + 1) == 0:
        del parent[key]
    else:
        parent[key] = pick(choose, VALUES)
    return json.dumps(table).replace(str(10**25), "9" * 400).encode()


def json_number(data: bytes, choose: Choose) -> bytes:
    """One number of a JSON file as another one."""
    table = json.loads(data)
    places = [(parent, key) for parent, key in _places(table) if isinstance(parent[key], int | float)]
    parent, key = pick(choose, places)
    parent[key] = pick(choose, NUMBERS)
    return json.dumps(table).encode()


def array_value(data: bytes, choose: Choose) -> bytes:
    """An array of an NPZ or NPY file with another number, another type or another shape, or left out."""
    loaded: Any = np.load(io.BytesIO(data))
    arrays = {"": loaded} if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    key = pick(choose, sorted(arrays))
    array = np.array(arrays[key])
    with np.errstate(over="ignore", invalid="ignore"):
        match choose.index(5):
            case 0:
                array = array.astype(pick(choose, ("f2", "f4", "f8", "i1", "u8", "c8", "S4", "U3", "?")))
            case 1:
                array = pick(choose, (array[None], array.ravel(), array[:0], array[..., :1], np.array(3.0)))
            case 2 if key:
                arrays[pick(choose, ("extra", "images2", "Focal"))] = array
            case _:
                array = array.astype(np.float64) if array.dtype.kind == "f" else array
                flat = array.reshape(-1)
                flat[choose.index(len(flat))] = np.array(pick(choose, NUMBERS)).astype(array.dtype)
    arrays[key] = array
    file = io.BytesIO()
    np.save(file, array) if key == "" else np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


BYTES: tuple[Callable[[bytes, Choose], bytes], ...] = (flip, cut, drop, repeat, word, number)
TEXT = (*BYTES[:4], token, token, token, nest)
JSON = (flip, cut, token, nest, json_value, json_value, json_number, json_number, json_number)
ARRAYS = (flip, cut, word, array_value, array_value, array_value)
KINDS = {".json": JSON, ".npz": ARRAYS, ".npy": ARRAYS, ".txt": TEXT, ".toml": TEXT, ".jsonl": TEXT}


def mutate(path: Path, choose: Choose) -> str:
    """Damage a file in place; returns the mutation's name."""
    change = pick(choose, KINDS.get(path.suffix, BYTES))
    path.write_bytes(change(path.read_bytes(), choose))
    return change.__name__


def _places(value: Any) -> list[tuple[Any, Any]]:
    keys: Any = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [place for key in keys for place in [(value, key), *_places(value[key])]]


def _over(data: bytes, choose: Choose, part: bytes) -> bytes:
    start = choose.index(max(1, len(data) - len(part)))
    return data[:start] + part + data[start + len(part) :]


def harmless(path: Path) -> bool:
    """Change a file so that it still means the same; whether there is a way for its format."""
    data = path.read_bytes()
    if path.suffix == ".json":
        table = json.loads(data)
        path.write_text(json.dumps(dict(reversed(table.items())) | {"a_key_that_is_not_known": [1, "a"]}, indent=3))
    elif path.suffix == ".toml":
        path.write_bytes(b"# a comment\n" + data.replace(b"\n", b"\r\n"))
    elif path.suffix == ".txt":
        path.write_bytes(b"# a comment\n" + data)
    elif path.suffix == ".png":
        chunk = b"tEXtComment\0a comment"
        text = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        path.write_bytes(data[:33] + text + data[33:])
    elif path.suffix == ".npz":
        loaded = np.load(io.BytesIO(data))
        np.savez_compressed(path, **{key: loaded[key] for key in reversed(loaded.files)})
    elif path.suffix == ".ply":
        path.write_bytes(data.replace(b"1.0\n", b"1.0\ncomment a comment\n", 1))
    else:
        return False
    return True
