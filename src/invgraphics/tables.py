"""Safe reading of untrusted files: JSON, TOML and NumPy arrays within limits on size, depth and digits.

What a file may cost is known before it is read: sizes are compared with `LIMITS` and with the memory there is, and what a
header claims is compared with the bytes behind it. Typed records are made of the plain values (`invgraphics.config.fill`).
"""

from __future__ import annotations

import io
import json
import math
import re
import struct
import tokenize
import tomllib
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from invgraphics.errors import InputError
from invgraphics.memory import check_fits, format_bytes


@dataclass(frozen=True)
class Limits:
    """Limits on the size, depth and digits of files.

    Attributes:
        json_bytes: length of a JSON file; a thousand posed photographs take about 1 MB.
        toml_bytes: length of a TOML file.
        depth: of tables and lists within each other, and parts of a dotted TOML key.
        digits: of a whole number; 64 bits need 20.
        members: arrays of an ``.npz`` archive.
    """

    json_bytes: int = 64 << 20
    toml_bytes: int = 1 << 20
    depth: int = 64
    digits: int = 20
    members: int = 10_000


LIMITS = Limits()

_AGAIN = "Write or copy the file again."
_DAMAGED = (
    OSError,
    ValueError,
    TypeError,
    SyntaxError,
    KeyError,
    EOFError,
    RuntimeError,  # of encrypted members; RecursionError
    MemoryError,  # of Python's parser, for deeply nested headers
    OverflowError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile and NumPy raise about damaged archives and headers."""
_KEY_PARTS = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{LIMITS.depth}}}")
"""A dotted key of too many parts, for which tomllib takes quadratic time and memory."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
"""An escape of half a character beyond the basic plane, in JSON."""
_HEADERS = {1: ("<H", np.lib.format.read_array_header_1_0), 2: ("<I", np.lib.format.read_array_header_2_0)}
"""Version of NumPy's format -> how the header's length is stored, and how the header is parsed."""
_LONGEST_HEADER = 10_000


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


def read_text(path: Path, most: int) -> str:
    """Read a UTF-8 text file of at most ``most`` bytes.

    Raises:
        InputError: it is missing, unreadable, no text, or longer.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
        text = data.decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8: byte {error.start} is not.") from error
    except (OSError, ValueError) as error:  # a NUL in the path is a ValueError
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    if len(data) > most:
        raise InputError(f"{path} is longer than {format_bytes(most)}, which no file of this kind is.")
    return text


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an ``.npz`` archive, with checksums verified.

    Raises:
        InputError: it is missing or damaged, a member is no array of numbers or text, or it does not fit into memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > LIMITS.members:
                raise ValueError(f"it has {len(members)} members")
            check_fits(sum(member.file_size for member in members), str(path), "Make it smaller: fewer or smaller pictures.")
            arrays = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name == member.filename or name in arrays:
                    raise ValueError(f"its member '{member.filename}' is {'there twice' if name in arrays else 'no array'}")
                with archive.open(member) as file:
                    arrays[name] = _array(file, member.file_size)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except _DAMAGED as error:
        raise _unreadable(path, error) from error
    return arrays


def read_numbers(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an ``.npz`` archive, which must hold real numbers or truth values.

    Raises:
        InputError: as `read_arrays`, or an array holds something else.
    """
    arrays = read_arrays(path)
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub":
            raise InputError(f"'{name}' of {path} holds {array.dtype}, not real numbers.", _AGAIN)
    return arrays


def read_array(path: Path) -> np.ndarray:
    """Read the array of an ``.npy`` file.

    Raises:
        InputError: it is missing or damaged, holds no numbers or text, or does not fit into memory.
    """
    try:
        size = path.stat().st_size
        check_fits(size, str(path), _AGAIN)
        with path.open("rb") as file:
            return _array(file, size)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except _DAMAGED as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: BaseException) -> InputError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"{path} cannot be read: {reason[:200].rstrip('.')}.", _AGAIN)


def _array(file: IO[bytes], size: int) -> np.ndarray:
    """Parse an array in NumPy's format (versions 1 and 2) whose header and data are exactly ``size`` bytes."""
    magic = file.read(8)
    if len(magic) < 8 or magic[:6] != b"\x93NUMPY" or magic[6] not in _HEADERS:
        raise ValueError("it is no NumPy array")
    form, read_header = _HEADERS[magic[6]]
    stated = file.read(struct.calcsize(form))
    length = struct.unpack(form, stated)[0]
    if length > _LONGEST_HEADER:
        raise ValueError(f"its header has {length} bytes")
    shape, fortran, dtype = read_header(io.BytesIO(stated + file.read(length)))
    if dtype.kind not in "fiubcSU" or dtype.itemsize == 0:
        raise ValueError(f"it holds {dtype}, neither numbers nor text")
    body = size - len(magic) - len(stated) - length
    if any(side < 0 for side in shape) or math.prod(shape) * dtype.itemsize != body:
        raise ValueError(f"{dtype} of shape {shape}, as its header claims, are not the {body} bytes that follow")
    array = np.empty(math.prod(shape), dtype)
    view = array.view(np.uint8).data if array.size else memoryview(b"")
    while view:
        count = file.readinto(view)  # type: ignore[attr-defined]
        if not count:
            raise EOFError("it is cut off")
        view = view[count:]
    file.read(1)  # the end, where zipfile compares the checksum
    return array.reshape(shape, order="F" if fortran else "C")


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
