"""Type check of the arrays that SIMD registers are loaded from and stored to."""

from __future__ import annotations

from typing import Any

from numba.core import errors, types


def check_array(values: Any, dtype: Any = types.float32) -> None:
    """Check, while a kernel is typed, that memory is an array of the type that it is read or written as.

    Raises:
        TypingError: it is another type, whose bytes would be taken for that one's.
    """
    if not isinstance(values, types.Array) or values.dtype != dtype:
        raise errors.TypingError(f"An array of {dtype} is read or written, not {values}.")
