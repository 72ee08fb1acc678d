"""How Triton kernels are launched here."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

once_differentiable: Any = torch.autograd.function.once_differentiable


def on_device_of(tensor: torch.Tensor) -> AbstractContextManager[Any]:
    """Makes a tensor's GPU the current one, onto which Triton launches; nothing where Triton's interpreter runs on a CPU."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else nullcontext()


def blocks(count: int, size: int) -> int:
    """How many blocks of ``size`` hold ``count`` items."""
    return -(-count // size)


def at_least_2(count: int) -> int:
    """The power of two that Triton needs as the length of a row of ``count`` columns."""
    return max(2, 1 << (count - 1).bit_length())
