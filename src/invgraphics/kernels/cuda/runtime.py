"""Launch helpers of Triton kernels."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch


def on_device_of(tensor: torch.Tensor) -> AbstractContextManager[Any]:
    """Context in which a tensor's GPU is current, as Triton launches need; a no-op for its interpreter on a CPU."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else nullcontext()


def blocks(count: int, size: int) -> int:
    """Number of blocks of ``size`` that hold ``count`` items."""
    return -(-count // size)


def at_least_2(count: int) -> int:
    """Power of two, at least 2, that pads ``count`` columns for Triton."""
    return max(2, 1 << (count - 1).bit_length())
