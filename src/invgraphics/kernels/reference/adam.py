"""Adam on the entries that a step touched, plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.types import AdamStep


@torch.no_grad()
def adam_rows(
    values: Float[Tensor, "*rows c"],
    gradient: Float[Tensor, "*rows c"] | Float[Tensor, "k c"],
    moments: tuple[Float[Tensor, "*rows c"], Float[Tensor, "*rows c"]],
    step: AdamStep,
    rates: Float[Tensor, "*rows"] | None = None,
    rows: Int[Tensor, " k"] | None = None,
) -> None:
    """See `invgraphics.kernels.adam_rows`."""
    if rows is not None:
        flat = [tensor.reshape(-1, tensor.shape[-1]) for tensor in (values, *moments)]
        value, first, second = (tensor[rows] for tensor in flat)
        adam_rows(value, gradient, (first, second), step, None if rates is None else rates.reshape(-1)[rows])
        for tensor, stepped in zip((values, *moments), (value, first, second), strict=True):
            tensor.copy_(tensor.reshape(-1, tensor.shape[-1]).index_copy(0, rows, stepped).reshape(tensor.shape))
        return
    first, second = moments
    touched = gradient != 0 if step.skip_zero else torch.ones_like(gradient, dtype=torch.bool)
    first.copy_(torch.where(touched, step.beta1 * first + (1 - step.beta1) * gradient, first))
    second.copy_(torch.where(touched, step.beta2 * second + (1 - step.beta2) * gradient**2, second))
    change = step.size * first / (second.sqrt() + step.eps)
    if rates is not None:
        change = change * rates[..., None]
    values.copy_(torch.where(touched, values - change, values))
