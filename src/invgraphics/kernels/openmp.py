"""How long OpenMP's threads spin while they wait, where the environment variable comes too late."""

from __future__ import annotations

import ctypes
import sys
import threading
from functools import cache
from pathlib import Path

from invgraphics.thread_pools import SPIN_SETTING_IS_LATE

MAPS = Path("/proc/self/maps")
"""Linux: what this process has loaded."""

LIBRARY = "libgomp"
"""GNU's OpenMP runtime, which torch brings on Linux and Numba uses as well."""


@cache
def limit_spinning() -> int:
    """Make idle OpenMP threads sleep at once where libgomp was loaded before `invgraphics` could set ``GOMP_SPINCOUNT``.

    libgomp reads that variable once, as it is loaded: whoever imports torch first gets threads that wait by spinning for
    milliseconds, and steps that take ten times as long beside one busy process. It documents, however, that threads spin a
    hundred times only while it manages more of them than there are processors. So one more thread of ours asks it for a team
    of that size, once, and then sleeps: the team stays, asleep too, and everyone's waiting is short from then on.

    Returns:
        How many runtimes were told; 0 where the variable was in force from the start.
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
    """Keep a team of more threads than processors asleep in the runtime at ``path``; whether that could be done."""
    try:
        runtime = ctypes.CDLL(path)
        parallel, nothing = runtime.GOMP_parallel, ctypes.cast(ctypes.CDLL(None).labs, ctypes.c_void_p)
        size = int(runtime.omp_get_num_procs()) + 1
    except (AttributeError, OSError):
        return False
    parallel.argtypes, parallel.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint), None
    ready = threading.Event()

    def hold() -> None:
        parallel(nothing, None, size, 0)  # every thread computes the absolute value of a null pointer
        ready.set()
        threading.Event().wait()  # a team ends with the thread that made it

    threading.Thread(target=hold, name="openmp-team", daemon=True).start()
    return ready.wait(timeout=10)
