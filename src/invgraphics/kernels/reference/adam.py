"""Adam on the entries that a step touched, plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.types import AdamStep


@torch.no_grad()
def adam_rows(
    values: Float[Tensor, "*rows c"],
    gradient: Float[Tensor, "*rows c"],
    moments: tuple[Float[Tensor, "*rows c"], Float[Tensor, "*rows c"]],
    step: AdamStep,
    rates: Float[Tensor, "*rows"] | None = None,
) -> None:
    """See `invgraphics.kernels.adam_rows`."""
    first, second = moments
    touched = gradient != 0 if step.skip_zero else torch.ones_like(gradient, dtype=torch.bool)
    first.copy_(torch.where(touched, step.beta1 * first + (1 - step.beta1) * gradient, first))
    second.copy_(torch.where(touched, step.beta2 * second + (1 - step.beta2) * gradient**2, second))
    change = step.size * first / (second.sqrt() + step.eps)
    if rates is not None:
        change = change * rates[..., None]
    values.copy_(torch.where(touched, values - change, values))
