"""What compiled operations share in autograd: errors instead of wrong second derivatives, and gradients of positions alone."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

Backward = Callable[..., Any]


class _NotTwice(torch.autograd.Function):
    """Identity whose derivative is an error."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, name: str) -> Tensor:
        ctx.name = name
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(
            f"Compiled kernels have no second derivative of {ctx.name}. With `invgraphics.kernels.using('reference')` around "
            "the forward pass it is the plain torch reference's."
        )


def once_differentiable(backward: Backward) -> Backward:
    """Decorator of a backward pass without a derivative: its gradients can be used, but not be differentiated.

    torch's decorator of that name raises an error only if the incoming gradients require one, as those of a square do; of a
    sum they do not, and the second derivative would silently be zero.
    """

    @functools.wraps(backward)
    def wrapped(ctx: Any, *grad_outputs: Any) -> Any:
        if not torch.is_grad_enabled():
            return backward(ctx, *grad_outputs)
        with torch.no_grad():
            found = backward(ctx, *grad_outputs)
        name = type(ctx).__name__.removesuffix("Backward").strip("_")
        gradients = found if isinstance(found, tuple) else (found,)
        return tuple(
            _NotTwice.apply(gradient.detach().requires_grad_(), name) if isinstance(gradient, Tensor) else gradient
            for gradient in gradients
        )

    return wrapped


class _Mode(threading.local):
    positions_only = False


_mode = _Mode()


@contextmanager
def gradients_of_positions() -> Iterator[None]:
    """Encode for vector-Jacobian products in positions: features from inside the block have no other gradient.

    That product is in turn differentiable in tables and cotangents, not in positions. Without this, compiled encodings compute
    the gradients of tables too wherever these require one, as autograd does not tell them what is asked for.
    """
    before, _mode.positions_only = _mode.positions_only, True
    try:
        yield
    finally:
        _mode.positions_only = before


def positions_only() -> bool:
    """Whether this thread is inside `gradients_of_positions`."""
    return _mode.positions_only
