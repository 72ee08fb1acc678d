"""The Polygon File Format as tables: elements are structured arrays, for as long as their records have one length."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from invgraphics.errors import InputError
from invgraphics.formats.base import HEAD_BYTES, truncation_error

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
_ENDIANNESS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"end_header\r?\n")
_DIGITS = 18  # of a count that fits into 64 bits


@dataclass(frozen=True)
class Header:
    """Header of a PLY file.

    Attributes:
        elements: name -> (number of records, type of one); none from the first element on that has a list.
        comments: free text.
        size: its own length in bytes.
    """

    elements: dict[str, tuple[int, np.dtype]]
    comments: tuple[str, ...]
    size: int


def read_header(path: Path, head: bytes) -> Header:
    """Read the header from the first bytes of a file.

    Raises:
        InputError: it is not the header of a binary PLY file.
    """
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"'{path}' is no PLY file: its header has no {'end' if head.startswith(b'ply') else 'beginning'}.")
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    comments, order, listed = [], "", False
    for line in head[: end.start()].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, "1.0"] if kind in _ENDIANNESS:
                order = _ENDIANNESS[kind]
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2])
            case ["element", name, count] if count.isdecimal() and len(count) <= _DIGITS and name not in elements:
                if not listed:
                    elements[name] = int(count), []
            case ["property", "list", *_] if elements or listed:
                if not listed:  # the records before it have one length and can be read
                    elements.popitem()
                listed = True
            case ["property", kind, name] if (elements or listed) and kind in _TYPES:
                if not listed:
                    elements[next(reversed(elements))][1].append((name, order + _TYPES[kind]))
            case []:
                pass
            case _:
                remedy = "Expected binary_little_endian, as 3DGS writes it." if line.startswith("format") else ""
                raise InputError(f"'{path}': the line '{line[:80]}' of its PLY header cannot be used.", remedy)
    if not order:
        raise InputError(f"'{path}': its PLY header names no format.")
    return Header(
        {name: (count, _record(path, fields)) for name, (count, fields) in elements.items()}, tuple(comments), end.end()
    )


def _record(path: Path, fields: list[tuple[str, str]]) -> np.dtype:
    try:
        return np.dtype(fields)
    except ValueError as error:
        raise InputError(f"'{path}': its PLY header is broken: {error}.") from error


def read_elements(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """All elements of a file as structured arrays, and its comments.

    Raises:
        InputError: it is not a binary PLY file, or is cut off.
    """
    data = path.read_bytes()
    header = read_header(path, data[:HEAD_BYTES])
    tables, start = {}, header.size
    for name, (count, record) in header.elements.items():
        end = start + count * record.itemsize
        if end > len(data):
            raise truncation_error(path, end, len(data))
        tables[name] = np.frombuffer(data, record, count, start) if record.itemsize else np.empty(0, record)
        start = end
    return tables, header.comments


def columns(table: np.ndarray, names: Sequence[str]) -> Tensor:
    """The named columns of a table side by side, float32 of shape (records, names)."""
    return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))


def missing(table: np.ndarray, names: Sequence[str]) -> list[str]:
    """Those of ``names`` that a table lacks."""
    return [name for name in names if name not in (table.dtype.names or ())]


def write_element(path: Path, element: str, table: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write one element of float32 properties, binary and little-endian."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element {element} {len(table)}", *(f"property float {name}" for name in table.dtype.names or ())]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii", errors="replace"))
        file.write(table.tobytes())
