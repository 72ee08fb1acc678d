"""Hardware limits (roofline): peak rates of matrix products, memory streams, gathers and exponentials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch

from invgraphics.kernels.dispatch import unavailable_reason

MATRIX = 2048
"""Edge of the square matrices of `sgemm`."""
TRIAD_FLOATS = 1 << 24
"""Floats per array of `triad`: 64 MB, more than caches hold."""
LOOKUPS = 1 << 22
EXP2_FLOATS, EXP2_PASSES = 4096, 16384
"""Floats per thread (16 KB, half an L1 cache), and how often one call goes over them."""
GATHER_BYTES = tuple(1 << power for power in (18, 20, 22, 25, 27))
"""Tables of the gather's curve, from an L2 cache's size to main memory."""


@dataclass(frozen=True)
class Limit:
    """A microbenchmark of a peak rate of the machine.

    Attributes:
        name: display name.
        amount: work of one call, in ``unit``.
        unit: unit of work.
        run: one call.
        sizes: its size, by `results.SIZE_KEYS`.
    """

    name: str
    amount: float
    unit: str
    run: Callable[[], object]
    sizes: dict[str, int]


@cache
def sgemm() -> Limit:
    """Dense float32 matrix product by torch; counts floating-point operations."""
    a, b = torch.ones(MATRIX, MATRIX), torch.ones(MATRIX, MATRIX)
    out = torch.empty(MATRIX, MATRIX)
    return Limit("sgemm", 2.0 * MATRIX**3, "flop", lambda: torch.mm(a, b, out=out), {"width": MATRIX})


@cache
def triad() -> Limit:
    """a = b + s c on arrays larger than the caches (McCalpin's STREAM); counts bytes read and written."""
    a, b, c = (torch.ones(TRIAD_FLOATS) for _ in range(3))
    run = lambda: torch.add(b, c, alpha=2.0, out=a)  # noqa: E731
    return Limit("triad", 12.0 * TRIAD_FLOATS, "bytes", run, {"bytes": 12 * TRIAD_FLOATS})


def gather(size: int) -> Limit | None:
    """Random reads of 8-byte entries in a table of ``size`` bytes; counts entries. ``None`` without Numba."""
    if unavailable_reason("numba"):
        return None
    import numpy as np

    from invgraphics.bench.probes import gather_sum
    from invgraphics.kernels.numba.runtime import threads

    entries = max(size // 8, 1)
    indices = np.random.default_rng(0).integers(0, entries, LOOKUPS, dtype=np.uint32)
    table, sums = np.ones(entries, np.int64), np.empty(torch.get_num_threads(), np.int64)
    run = lambda: gather_sum(table, indices, threads(), sums)  # noqa: E731
    return Limit(f"gather {readable_bytes(size)}", float(LOOKUPS), "look-ups", run, {"bytes": size})


def exp2() -> Limit | None:
    """The kernels' exp2 polynomial on arrays in the L1 cache; counts exponentials. ``None`` without Numba."""
    if unavailable_reason("numba"):
        return None
    import numpy as np

    from invgraphics.bench.probes import exp2_passes
    from invgraphics.kernels.numba.runtime import threads

    jobs = threads()
    values = np.random.default_rng(0).uniform(-1, 0.5, (jobs, EXP2_FLOATS)).astype(np.float32)
    amount = float(values.size * EXP2_PASSES)
    return Limit("exp2", amount, "alpha evaluations", lambda: exp2_passes(values, EXP2_PASSES), {})


def all_limits() -> list[Limit]:
    """All limits that can be measured on this machine."""
    found = [sgemm(), triad(), exp2(), *(gather(size) for size in GATHER_BYTES)]
    return [limit for limit in found if limit is not None]


def readable_bytes(size: float) -> str:
    """``262144`` as ``256 KB``; powers of 1024."""
    for unit in ("B", "KB", "MB", "GB"):
        if size < 1024 or unit == "GB":
            return f"{size:.3g} {unit}"
        size /= 1024
    raise AssertionError
