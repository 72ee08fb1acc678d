"""Numba runtime: compiler flags, compilation in helper processes, threads, scratch memory and fast math functions."""

from __future__ import annotations

import contextlib
import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

# Measured on Linux: with torch in the same process, Numba's own first choice (tbb) and `workqueue` are 1.6 times slower.
if sys.platform == "linux":
    os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")

import numba as nb
import numpy as np
import torch
from numba.core import event

if nb.config.DISABLE_JIT:  # type: ignore[attr-defined]
    raise ImportError("NUMBA_DISABLE_JIT is set")

PACKAGE = __name__.rpartition(".")[0]
WARMUP, PARTS = f"{PACKAGE}.warmup", ("splats", "samples")
"""Module and its functions that together call every kernel; the functions take equally long to compile."""

FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""LLVM's fast-math without ``nnan`` and ``ninf``: comparisons must sort out NaN and infinity, not assume them away."""

_Decorator = Callable[[Callable[..., Any]], Any]


def _njit(**options: Any) -> _Decorator:
    """`numba.njit` with NumPy's division by zero (infinity) and without a C wrapper."""
    return partial(nb.njit, error_model="numpy", no_cfunc_wrapper=True, **options)


class _NotCachedError(Exception):
    """A kernel would have to be compiled in this process."""


class _Compiler(event.Listener):
    """On a cache miss, has all kernels compiled by short-lived helper processes that fill the cache on disk.

    What they cannot provide (they cannot start, the cache is not writable, other argument types) is compiled in this process.
    """

    def __init__(self) -> None:
        self.here = False
        self.kernels: set[Any] = set()
        self._lock = threading.Lock()

    def on_start(self, event: Any) -> None:
        if not self.here and (event.data or {}).get("dispatcher") in self.kernels:
            raise _NotCachedError

    def on_end(self, event: Any) -> None:
        pass

    def run(self) -> None:
        """Fill the cache, once in the life of this process."""
        with self._lock:
            if not self.here:
                print("compiling kernels, once, up to two minutes", file=sys.stderr, flush=True)
                with contextlib.suppress(OSError):
                    # Compilation is single-threaded: two processes share it.
                    for process in [_start_warmup(part) for part in PARTS]:
                        process.wait()
                self.here = True


def _start_warmup(part: str) -> subprocess.Popen[bytes]:
    """Start a helper process that runs, and so compiles, one of the `PARTS`."""
    code = f"import {__name__} as runtime, {WARMUP} as warmup; runtime.compile_here(); warmup.{part}()"
    return subprocess.Popen([sys.executable, "-P", "-c", code], stderr=subprocess.DEVNULL)


_compiler = _Compiler()
event.register("numba:compile", _compiler)


def source_digest() -> str:
    """SHA-256 over the names and texts of all modules of kernels, the references too: their constants are compiled in."""
    digest, root = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


SOURCES = source_digest()


def _stamp(kernel: Any) -> None:
    """Have a kernel compiled anew whenever any module of kernels has changed.

    Numba's stamp is that of the kernel's own file, but the device functions inlined into it lie in others: after a change there
    the old machine code would be loaded. Numba has no public way to add to the stamp; a version whose cache has another form
    keeps its own.
    """
    with contextlib.suppress(AttributeError):
        file = kernel._cache._cache_file
        file._source_stamp = (file._source_stamp, SOURCES)


def _cached(**options: Any) -> _Decorator:
    """`_njit` for kernels called from Python: machine code always comes from the cache on disk, filled by a helper process.

    A kernel that is compiled and one that is loaded are not the same bits: the loop's body is optimised on its own, and
    again with the function around it. The process that compiles runs the first version, all later ones the second.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = _njit(cache=True, nogil=True, **options)(function)
        _stamp(kernel)
        load = kernel.compile

        def compile_or_load(signature: Any) -> Any:
            try:
                return load(signature)
            except _NotCachedError:
                _compiler.run()
                return load(signature)

        # Kernels of other packages that use these decorators are unknown to `warmup`.
        if function.__module__.startswith(PACKAGE):
            kernel.compile = compile_or_load
            _compiler.kernels.add(kernel)
        return kernel

    return decorate


parallel = _cached(parallel=True, fastmath=FASTMATH)
"""Decorator of kernels that loop over jobs with `prange`, one job per thread."""
serial = _cached(fastmath=FASTMATH)
"""Decorator of kernels that one thread runs."""
inlined = _njit(fastmath=FASTMATH, forceinline=True, no_cpython_wrapper=True)
"""Decorator of device functions, inlined into the kernels that call them and cached as part of those."""
ordered = _njit(fastmath=FASTMATH - {"reassoc"}, forceinline=True, no_cpython_wrapper=True)
"""`inlined` without reassociation: rearranged sums become one dependency chain."""
exact_parallel = _cached(parallel=True, fastmath=False)
exact = _njit(fastmath=False, forceinline=True, no_cpython_wrapper=True)
"""`parallel` and `inlined` in plain IEEE arithmetic; an inlined function without flags inherits its caller's."""

# Typed in a way that no checker can follow.
prange: Any = nb.prange

# Starting Numba's threads sets OpenMP's thread count for the whole process, torch's too: put it back.
_torch_threads = torch.get_num_threads()
nb.set_num_threads(nb.get_num_threads())
torch.set_num_threads(_torch_threads)

# Signed indices are tested for wrap-around, which keeps LLVM from vectorising: hot loops index with this type.
index = np.uintp

LANES = index(16)
"""SIMD width of the kernels: one or two vector registers of float32."""
GROUP = int(LANES)
"""`LANES` as a signed integer: Numba turns mixed signed and unsigned arithmetic into floats."""


def threads() -> int:
    """Number of jobs to split work into: torch's thread count, which is set for Numba as well.

    Work is split statically, so results are bitwise reproducible for a given number of threads.
    """
    count = max(1, min(torch.get_num_threads(), int(nb.config.NUMBA_NUM_THREADS)))  # type: ignore[attr-defined]
    if nb.get_num_threads() != count:
        nb.set_num_threads(count)
    return count


def array(tensor: torch.Tensor) -> np.ndarray:
    """A contiguous NumPy view (or copy) of a CPU tensor."""
    return tensor.detach().contiguous().numpy()


class _Scratch(threading.local):
    """Reusable buffers, one set per Python thread."""

    def __init__(self) -> None:
        self.buffers: dict[tuple[str, np.dtype], np.ndarray] = {}


_scratch = _Scratch()


def scratch(name: str, size: int, dtype: Any = np.float32) -> np.ndarray:
    """An uninitialised flat buffer, reused by the next call with this name: fresh memory costs page faults.

    Its content survives only until the next call with the same name, so nothing that a backward pass needs may be in it.
    """
    key = (name, np.dtype(dtype))
    buffer = _scratch.buffers.get(key)
    if buffer is None or buffer.size < size:
        buffer = _scratch.buffers[key] = np.empty(max(size + size // 4, 1), dtype)
    return buffer[:size]


def compile_here() -> None:
    """Compile in this process from now on, without helper processes."""
    _compiler.here = True


@inlined
def job_start(count: int, jobs: int, job: int) -> int:
    """First of ``count`` evenly split items of ``job``; job ``jobs`` starts at the end."""
    return count * job // jobs


@serial
def split_by_work(work: np.ndarray, jobs: int, first: np.ndarray) -> None:
    """Partition consecutive items into ``jobs`` ranges of about equal work; range j is ``first[j] .. first[j + 1] - 1``."""
    total = work.sum() + len(work)
    done, job = 0, 1
    first[0] = 0
    for i in range(len(work)):
        done += work[i] + 1
        while job < jobs and done * jobs >= total * job:
            first[job] = i + 1
            job += 1
    first[job:] = len(work)


@inlined
def exp2_fraction(f):
    """``2**f - 1`` for f in [-1/2, 1/2], scalar or SIMD register: minimax polynomial, relative error of ``2**f`` 9.1e-8."""
    p = np.float32(0.00132647272)
    p = p * f + np.float32(0.00967151281)
    p = p * f + np.float32(0.0555073374)
    p = p * f + np.float32(0.240222421)
    p = p * f + np.float32(0.693146978)
    return p * f


@inlined
def power_minus_one(x):
    """``2**f - 1`` and ``2**n`` with x = f + n, n whole and f in [-1/2, 1/2], for x in [-126, 127], clamped below.

    Polynomials, because LLVM vectorises no library call; ``2**x`` is `exp2`, to 1e-7 relative.
    """
    x = max(x, np.float32(-126.0))
    whole = np.floor(x + np.float32(0.5))
    power = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
    return exp2_fraction(x - whole), power


@inlined
def exp2(x):
    """``2**x`` for x in [-126, 127], clamped below."""
    fraction, scale = power_minus_one(x)
    return (fraction + np.float32(1.0)) * scale


@inlined
def log2(x):
    """Binary logarithm of a positive normal number, relative error 1e-7; vectorisable, unlike NumPy's."""
    bits = np.float32(x).view(np.int32)
    # x = m 2^whole with m in [sqrt(1/2), sqrt(2)).
    whole = (bits - np.int32(0x3F3504F3)) >> np.int32(23)
    m = np.int32(bits - np.int32(whole << np.int32(23))).view(np.float32)
    # log2 m = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...)
    s = (m - np.float32(1.0)) / (m + np.float32(1.0))
    square = s * s
    p = np.float32(0.412198583)
    p = p * square + np.float32(0.577078016)
    p = p * square + np.float32(0.961796694)
    p = p * square + np.float32(2.88539008)
    return np.float32(whole) + s * p
