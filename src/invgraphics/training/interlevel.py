"""The loss of proposals: each level's weights bound those of the level that is rendered (mip-NeRF 360, §3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from invgraphics.core import Batch, Context, Rendering, Samples, Trace

LEAST_WEIGHT = torch.finfo(torch.float32).eps
"""Added to the weight by which an excess is divided (multinerf, ``lossfun_outer``)."""


@dataclass(frozen=True)
class InterlevelLoss:
    """Mip-NeRF 360's proposal loss (equations 12 and 13): rendered weight above the proposal's upper bound.

    The bound for an interval is the sum of the proposal's weights in the intervals that it overlaps. Gradients reach the
    proposals' weights only, not the rendered ones, and no level's samples.

    Attributes:
        weight: factor.
    """

    weight: float = 1.0

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted sum over levels of means over intervals; exactly 0 where no weight exceeds its bound."""
        total = batch.target.new_zeros(())
        if trace.samples is None or trace.weights is None or len(trace.samples) == 0:
            return total
        t0, t1, weights = (x.detach() for x in per_ray(trace.samples, trace.weights))
        for level in trace.levels:
            if level.samples is None or level.weights is None or not level.weights.requires_grad:
                continue
            bound = outer_measure(t0, t1, *per_ray(level.samples, level.weights))
            excess = (weights - bound).clamp_min(0)
            total = total + (excess.square() / (weights + LEAST_WEIGHT)).mean()
        return self.weight * total


def per_ray(samples: Samples, weights: Float[Tensor, " m"]) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, ends and weights of packed samples as (k, n) tables of rays that have the same number n each."""
    count = int(torch.searchsorted(samples.ray, samples.ray[:1], right=True))
    return samples.t0.view(-1, count), samples.t1.view(-1, count), weights.view(-1, count)


def outer_measure(
    t0: Float[Tensor, "k n"],
    t1: Float[Tensor, "k n"],
    lower: Float[Tensor, "k c"],
    upper: Float[Tensor, "k c"],
    weights: Float[Tensor, "k c"],
) -> Float[Tensor, "k n"]:
    """Sum of the weights of all intervals [lower, upper] that overlap [t0, t1].

    Summed in float64, so that in float32 a histogram bounds itself to the last bit.

    Args:
        t0: where the intervals begin.
        t1: where they end.
        lower: where each row's adjoining intervals with weights begin, increasing.
        upper: where they end.
        weights: of these, >= 0.
    """
    sums = pad(weights.double().cumsum(dim=1), (1, 0))
    first = torch.searchsorted(upper.contiguous(), t0.contiguous(), right=True)
    behind = torch.searchsorted(lower.contiguous(), t1.contiguous())
    return (sums.gather(1, torch.maximum(first, behind)) - sums.gather(1, first)).to(weights.dtype)
