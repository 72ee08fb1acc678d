"""Memory reuse by the C library's allocator across training steps, and its end."""

from __future__ import annotations

import ctypes

# Numbers and meaning: mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_TRIM, _LARGEST_BLOCKS = 2**31 - 1, (2**30, 2**25)
"""Thresholds, largest first: older versions of glibc refuse blocks above 32 MiB."""


def keep_freed_memory() -> bool:
    """Make glibc keep freed memory, in blocks of up to 1 GB, instead of returning it to the system at every step.

    Fresh pages cost a fault each: a sixth of a step of a hash grid of 2^19 entries, whose gradient is 64 MB.

    Returns:
        Whether the settings were accepted; ``False`` on other C libraries, which are left as they are.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    # Any setting ends the automatic choice of both thresholds, so that a trim threshold alone would make things worse.
    if not any(mallopt(_MMAP_THRESHOLD, size) == 1 for size in _LARGEST_BLOCKS):
        return False
    return mallopt(_TRIM_THRESHOLD, _LARGEST_TRIM) == 1


def return_freed_memory() -> bool:
    """Return freed memory to the system at once; whether there was any. ``False`` where the C library is not glibc."""
    try:
        return ctypes.CDLL(None).malloc_trim(0) == 1
    except (AttributeError, OSError, TypeError):
        return False
