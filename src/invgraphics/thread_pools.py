"""Cores that thread pools may use, and how long their waiting threads may spin, which is set before torch is imported."""

import os
import sys

SPIN_SETTING_IS_LATE = "torch" in sys.modules and not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & os.environ.keys()
"""Whether torch has read the environment without the setting below; `invgraphics.kernels.openmp` then finds another way."""

# torch and Numba bring a thread pool each. A thread that waits by spinning takes the core that the other pool's thread needs;
# with one more busy process on two cores, steps then took ten times as long. Read by libgomp when torch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")


def usable_cores() -> int:
    """Cores that this process may use: fewer than the machine has where it is pinned to some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
