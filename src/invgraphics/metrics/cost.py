"""What a method costs: memory, time per picture, size."""

from __future__ import annotations

import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType

import torch
from torch import nn

STATM = Path("/proc/self/statm")
"""Linux: sizes of this process in pages; the second number is the resident set."""

SAMPLING_SECONDS = 0.02
"""How often the resident set is read. Shorter peaks can be missed."""


def synchronise(device: torch.device | str) -> None:
    """Wait until ``device`` has finished what was asked of it, so that a clock read next tells the truth."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def resident_bytes() -> int:
    """Memory that this process holds now; where the system does not say (no ``/proc``), the most it has ever held."""
    import resource

    if STATM.exists():
        return int(STATM.read_text().split()[1]) * resource.getpagesize()
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class PeakMemory:
    """Measures, within a ``with`` block, the most memory held above what was held at its start.

    On a CPU this is the process's resident set, sampled by a thread; on CUDA, torch's allocator.

    Args:
        device: where the work happens.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)
        self._start = 0
        self._peak = 0

    def __enter__(self) -> PeakMemory:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
            torch.cuda.reset_peak_memory_stats(self._device)
        self._start = self._peak = self._held()
        if self._device.type != "cuda":
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._read()

    @property
    def peak_bytes(self) -> int:
        """The highest reading above the first; complete once the block has been left."""
        return self._peak - self._start

    def _held(self) -> int:
        return torch.cuda.max_memory_allocated(self._device) if self._device.type == "cuda" else resident_bytes()

    def _read(self) -> None:
        self._peak = max(self._peak, self._held())

    def _watch(self) -> None:
        while not self._stop.wait(SAMPLING_SECONDS):
            self._read()


def median_seconds(work: Callable[[], object], device: torch.device | str, repeats: int = 5, warm_up: int = 1) -> float:
    """Median wall-clock seconds of ``work()``, after calls that compile, allocate and fill caches.

    Args:
        work: for instance the rendering of one view.
        device: waited for before every reading of the clock.
        repeats: timed calls, >= 1.
        warm_up: calls before them that do not count.
    """
    for _ in range(warm_up):
        work()
    seconds = []
    for _ in range(repeats):
        synchronise(device)
        start = time.perf_counter()
        work()
        synchronise(device)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def model_bytes(modules: Iterable[nn.Module]) -> int:
    """Bytes of all parameters and buffers, shared tensors counted once."""
    tensors = {id(tensor): tensor for module in modules for tensor in (*module.parameters(), *module.buffers())}
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def parameter_count(modules: Iterable[nn.Module]) -> int:
    """Numbers that are optimised, shared parameters counted once."""
    parameters = {id(parameter): parameter for module in modules for parameter in module.parameters()}
    return sum(parameter.numel() for parameter in parameters.values() if parameter.requires_grad)
