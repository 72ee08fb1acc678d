"""Costs of a method: peak memory and model size."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import TracebackType

import torch
from torch import nn

from invgraphics.kernels.allocator import return_freed_memory
from invgraphics.memory import peak_resident_bytes, reset_peak, resident_bytes

SAMPLING_SECONDS = 0.02
"""How often the resident set is read where the kernel's record cannot be set back. Shorter peaks are then missed."""


class PeakMemory:
    """Peak memory within a ``with`` block, above that at its start.

    On a CPU this is the process's resident set: Linux records its peak, elsewhere a thread samples it. On CUDA it is that of
    torch's allocator. Blocks must not overlap in time.

    Args:
        device: where the work happens.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)
        self._start = 0
        self._peak = 0
        self._recorded = self._paused = False

    def __enter__(self) -> PeakMemory:
        return_freed_memory()  # memory freed before would hide growth within it
        self._restart()
        self._start = self._peak = self._held()
        if self._device.type != "cuda" and not self._recorded:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._read()
        self._paused = True

    @contextmanager
    def excluding(self) -> Iterator[None]:
        """Exclude what a nested block needs: memory that it freed goes back to the system, and the record starts anew."""
        self._read()
        self._paused = True
        try:
            yield
        finally:
            return_freed_memory()
            self._restart()
            self._paused = False

    @property
    def peak_bytes(self) -> int:
        """Peak bytes above the level at the start, so far."""
        self._read()
        return self._peak - self._start

    def include(self, peak: int) -> None:
        """Count a peak of earlier work, in bytes above its own start: that of the process whose fit is resumed."""
        self._peak = max(self._peak, self._start + peak)

    def _restart(self) -> None:
        """Set the record of the largest amount back to what is held now."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
            torch.cuda.reset_peak_memory_stats(self._device)
        else:
            self._recorded = reset_peak()

    def _held(self) -> int:
        if self._device.type == "cuda":
            return torch.cuda.max_memory_allocated(self._device)
        recorded = peak_resident_bytes() if self._recorded else None
        return resident_bytes() if recorded is None else recorded

    def _read(self) -> None:
        if not self._paused:
            self._peak = max(self._peak, self._held())

    def _watch(self) -> None:
        while not self._stop.wait(SAMPLING_SECONDS):
            self._read()


def model_bytes(modules: Iterable[nn.Module]) -> int:
    """Bytes of all parameters and buffers, shared tensors counted once."""
    tensors = {id(tensor): tensor for module in modules for tensor in (*module.parameters(), *module.buffers())}
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def parameter_count(modules: Iterable[nn.Module]) -> int:
    """Number of trainable parameters, shared ones counted once."""
    parameters = {id(parameter): parameter for module in modules for parameter in module.parameters()}
    return sum(parameter.numel() for parameter in parameters.values() if parameter.requires_grad)
