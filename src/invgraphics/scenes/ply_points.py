"""Known surface points with colours from a PLY file, as text or binary, whoever wrote it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch

from invgraphics.core import Points
from invgraphics.errors import InputError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"end_header\r?\n")
_COLOURS = ("red", "green", "blue")
_DIGITS = 18  # of a count that fits into 64 bits
_GREY = 0.5  # of points without colours
BRIGHT = 2.0
"""Brightest colour of floats from 0 to 1: some overshoot white."""


def read_points(path: Path) -> Points | None:
    """Read the vertices of a PLY file and their colours; ``None`` where there are none.

    Colours are whole numbers up to 255, or up to 65535 where one exceeds that, or floats up to 1, or up to 255 where one
    exceeds `BRIGHT`; without any, points are grey. Points that are not finite are left out.

    Raises:
        InputError: it cannot be read, is no such file, or is cut off.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    end = _END.search(data)
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path} is no PLY file: its header has no {'end' if data.startswith(b'ply') else 'beginning'}.")
    kind, count, record = _vertices(path, data[: end.start()].decode("ascii", errors="replace"))
    table = (
        _read_text(path, data[end.end() :], count, record)
        if kind == "ascii"
        else _read_binary(path, data[end.end() :], count, record)
    )
    position = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    rgb = np.full(position.shape, _GREY, np.float32)
    if all(name in (record.names or ()) for name in _COLOURS):
        rgb = np.stack([table[name].astype(np.float32) for name in _COLOURS], axis=1)
        rgb /= _white(float(rgb[np.isfinite(rgb)].max(initial=0)), whole=record["red"].kind in "iu")
    whole = np.isfinite(position).all(axis=1) & np.isfinite(rgb).all(axis=1)
    if not whole.any():
        return None
    return Points(torch.from_numpy(position[whole]), torch.from_numpy(rgb[whole].clip(0, 1)))


def _white(highest: float, *, whole: bool) -> int:
    """Value that stands for 1 among colours of which one has the value ``highest``."""
    if whole:
        return 255 if highest <= 255 else 65535
    return 1 if highest <= BRIGHT else 255


def _vertices(path: Path, header: str) -> tuple[str, int, np.dtype]:
    """Format of a file, number of its vertices, and the type of one."""
    kind, count, elements = "", 0, []
    fields: list[tuple[str, str]] = []
    for line in header.splitlines():
        match line.split():
            case ["format", name, *_]:
                kind = name
            case ["element", name, number] if number.isdecimal() and len(number) <= _DIGITS:
                count = count if elements else int(number)
                elements.append(name)
            case ["property", name, field] if len(elements) == 1 and name in _TYPES:
                fields.append((field, _TYPES[name]))
            case ["property", *_] if len(elements) == 1:
                raise InputError(f"{path}: vertices with '{line[:80]}' cannot be read.")
    names = [name for name, _ in fields]
    if kind not in _ORDERS or elements[:1] != ["vertex"] or not {*"xyz"} <= {*names} or len(set(names)) < len(names):
        raise InputError(f"{path} is no PLY file of points.", "Expected: vertices first, each with x, y and z.")
    return kind, count, np.dtype([(name, _ORDERS[kind] + letters) for name, letters in fields])


def _read_binary(path: Path, body: bytes, count: int, record: np.dtype) -> np.ndarray:
    if len(body) < count * record.itemsize:
        raise _cut_off(path, len(body) // record.itemsize, count)
    return np.frombuffer(body, record, count)


def _read_text(path: Path, body: bytes, count: int, record: np.dtype) -> np.ndarray:
    names = record.names or ()
    words = body.split(maxsplit=min(count * len(names), len(body)))[: count * len(names)]
    if len(words) < count * len(names):
        raise _cut_off(path, len(words) // len(names), count)
    try:
        values = np.array(words, dtype=np.float64).reshape(count, len(names))
    except ValueError as error:
        raise InputError(f"{path} has a vertex that is no numbers: {error}.") from error
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is left out by the caller
        return np.rec.fromarrays(values.T, dtype=record)


def _cut_off(path: Path, found: int, count: int) -> InputError:
    return InputError(f"{path} is cut off: it has {found:,} of {count:,} vertices.", "Copy it again.")
