"""Kernel dispatch: the implementation is chosen by device, dtype and availability, or forced by name."""

from __future__ import annotations

import importlib
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch

from invgraphics.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterator

IMPLEMENTATIONS = ("reference", "numba", "cuda")
"""Packages beside this file; each exports the operations it implements, under the names of `invgraphics.kernels`."""

DEVICES = {"numba": "cpu", "cuda": "cuda"}
"""Device type of each compiled implementation; the reference runs on any."""

_forced: str | None = None


def use(name: str | None) -> None:
    """Force an implementation for all operations (``None``: choose automatically).

    Raises:
        InputError: unknown name, or the implementation does not work on this machine.
    """
    if name is not None and name not in IMPLEMENTATIONS:
        raise InputError(
            f"There are no '{name}' kernels.{did_you_mean(name, IMPLEMENTATIONS)}",
            f"Known kernels: {', '.join(IMPLEMENTATIONS)}.",
        )
    if name is not None and unavailable_reason(name):
        raise InputError(f"The {name} kernels cannot be used here: {unavailable_reason(name)}.")
    global _forced  # noqa: PLW0603
    _forced = name


@contextmanager
def using(name: str | None) -> Iterator[None]:
    """Force an implementation for the length of a ``with`` block."""
    before = _forced
    use(name)
    try:
        yield
    finally:
        use(before)


@cache
def _module(name: str) -> ModuleType | str:
    """The implementation's package, or why it cannot be imported."""
    try:
        return importlib.import_module(f"invgraphics.kernels.{name}")
    except Exception as error:  # a broken Numba raises anything from ImportError to OSError
        return f"{type(error).__name__}: {error}"


def unavailable_reason(name: str) -> str:
    """Reason why an implementation is not available on this machine; empty if it is."""
    if name == "cuda" and not torch.cuda.is_available():
        return "torch finds no CUDA device"
    module = _module(name)
    return module if isinstance(module, str) else ""


def cpu_implementations() -> tuple[str, ...]:
    """Available implementations for CPU tensors, the reference first."""
    return tuple(name for name in IMPLEMENTATIONS if DEVICES.get(name, "cpu") == "cpu" and not unavailable_reason(name))


def choose(operation: str, like: torch.Tensor, *others: torch.Tensor | None) -> Any:
    """The function that runs ``operation`` for tensors like ``like`` and ``others``.

    Compiled kernels are written for float32 on one kind of device; everything else, mixed dtypes included, runs on the plain
    torch reference.
    """
    name = _name_for(like.device.type)
    if like.dtype == torch.float32 and DEVICES.get(name) == like.device.type and all(map(_is_float32, others)):
        module = _module(name)
        if isinstance(module, ModuleType) and hasattr(module, operation):
            return getattr(module, operation)
    return getattr(_module("reference"), operation)


def _is_float32(tensor: torch.Tensor | None) -> bool:
    """Whether a tensor is float32, or of no floating dtype; an operand that is not there counts too."""
    return tensor is None or tensor.dtype == torch.float32 or not tensor.is_floating_point()


def compiled(operation: str, like: torch.Tensor) -> bool:
    """Whether an implementation other than the reference runs ``operation`` for tensors like ``like``."""
    return choose(operation, like) is not getattr(_module("reference"), operation)


def _name_for(kind: str) -> str:
    """Implementation selected for a device type: the forced one, else the one compiled for it."""
    return _forced or next((name for name, device in DEVICES.items() if device == kind), "reference")


def in_use(device: torch.device | None = None) -> str:
    """Name of the implementation of float32 kernels on a device (``None``: the CPU), for a run's record."""
    kind = "cpu" if device is None else device.type
    name = _name_for(kind)
    return name if DEVICES.get(name) == kind and not unavailable_reason(name) else "reference"


def warm_up(device: torch.device | None = None) -> float:
    """Compile the kernels of a device (``None``: the CPU) ahead of time, so that no fit's clock includes it; returns seconds.

    Kernels of a GPU compile at their first call, which a fit's discarded warm-up step makes.
    """
    module = _module("numba") if in_use(device) == "numba" else None
    return module.warm_up() if isinstance(module, ModuleType) and hasattr(module, "warm_up") else 0.0
