"""Safe reading of untrusted files: NumPy's arrays and archives, without pickles and within the memory there is.

What a header claims is compared with the bytes behind it before anything of that size is made.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from invgraphics.errors import InputError
from invgraphics.memory import check_fits

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
_HEADERS = {1: ("<H", np.lib.format.read_array_header_1_0), 2: ("<I", np.lib.format.read_array_header_2_0)}
"""Version of NumPy's format -> how the header's length is stored, and how the header is parsed."""
_LONGEST_HEADER = 10_000
_MOST_MEMBERS = 10_000
"""Arrays of an ``.npz`` archive."""


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an ``.npz`` archive, with checksums verified.

    Raises:
        InputError: it is missing or damaged, a member is no array of numbers or text, or it does not fit into memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > _MOST_MEMBERS:
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
