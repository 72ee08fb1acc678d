"""OpenMP spin-wait limit of an already loaded runtime, where the environment variable comes too late."""

from __future__ import annotations

import ctypes
import sys
import threading
from functools import cache
from pathlib import Path

from invgraphics.thread_pools import SPIN_SETTING_IS_LATE

MAPS = Path("/proc/self/maps")
"""Linux: memory mappings of this process, which name its shared libraries."""

LIBRARY = "libgomp"
"""GNU's OpenMP runtime, bundled with torch on Linux and used by Numba as well."""


@cache
def limit_spinning() -> int:
    """Make idle OpenMP threads sleep at once where libgomp was loaded before `invgraphics` could set ``GOMP_SPINCOUNT``.

    libgomp reads that variable once, as it is loaded: if torch was imported first, idle threads spin for milliseconds, and
    steps take ten times as long beside one busy process. Its documentation limits spinning to a hundred iterations while it
    manages more threads than there are processors. So a helper thread starts one team of that size and then sleeps: the team
    stays alive, asleep too, and spinning is short from then on.

    Returns:
        Number of runtimes limited this way; 0 where the variable was in force from the start.
    """
    if not SPIN_SETTING_IS_LATE or not sys.platform.startswith("linux"):
        return 0
    return sum(_hold_team(path) for path in _loaded())


def _loaded() -> list[str]:
    """Paths of the OpenMP runtimes of this process."""
    try:
        lines = MAPS.read_text().splitlines()
    except OSError:
        return []
    return sorted({path for line in lines if (path := line.partition("/")[1] + line.partition("/")[2]) and LIBRARY in path})


def _hold_team(path: str) -> bool:
    """Keep a sleeping team of more threads than processors alive in the runtime at ``path``; returns success."""
    try:
        runtime = ctypes.CDLL(path)
        parallel, no_op = runtime.GOMP_parallel, ctypes.cast(ctypes.CDLL(None).labs, ctypes.c_void_p)
        size = int(runtime.omp_get_num_procs()) + 1
    except (AttributeError, OSError):
        return False
    parallel.argtypes, parallel.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint), None
    ready = threading.Event()

    def hold() -> None:
        parallel(no_op, None, size, 0)  # every thread computes the absolute value of a null pointer
        ready.set()
        threading.Event().wait()  # a team ends with the thread that started it

    threading.Thread(target=hold, name="openmp-team", daemon=True).start()
    return ready.wait(timeout=10)
