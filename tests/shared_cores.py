"""Processes that test side by side share the cores: with more threads than cores, training takes 1.4 times as long.

``tests/kernels`` takes all cores, see its ``conftest.py``.
"""

import os

if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    _THREADS = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, _THREADS)))
