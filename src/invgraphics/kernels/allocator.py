"""The C library's allocator, told that this process will want the same memory again."""

from __future__ import annotations

import ctypes

# Numbers and meaning: mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST = {_TRIM_THRESHOLD: 2**31 - 1, _MMAP_THRESHOLD: 2**30}


def keep_freed_memory() -> bool:
    """Let glibc keep what is freed, up to blocks of 1 GB, instead of returning it and asking for it again at every step.

    Fresh pages cost a fault each: a sixth of a step of a hash grid of 2^19 entries, whose gradient is 64 MB.

    Returns:
        Whether the allocator agreed; ``False`` on other C libraries, which are left alone.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return all(mallopt(setting, value) == 1 for setting, value in _LARGEST.items())
