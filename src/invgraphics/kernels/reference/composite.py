"""Volume-rendering quadrature (emission-absorption) over packed samples, plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

OPAQUE = 1e3
"""Optical depths are clamped here: exp(-1000) is 0 even in float64, and an infinite density would spoil later rays' sums."""


def composite(
    optical_depth: Float[Tensor, " m"], channels: Float[Tensor, "m c"], ray: Int[Tensor, " m"], rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.composite`."""
    tau = optical_depth.double().clamp_max(OPAQUE)
    weights = (transmittance(tau, ray, rays) * -torch.expm1(-tau)).to(optical_depth.dtype)
    sums = channels.new_zeros(rays, channels.shape[1]).index_add(0, ray, weights[:, None] * channels)
    alpha = weights.new_zeros(rays).index_add(0, ray, weights)
    return weights, sums, alpha


def transmittance(tau: Float[Tensor, " m"], ray: Int[Tensor, " m"], rays: int) -> Float[Tensor, " m"]:
    """Transmittance before each sample, exp(-sum of nearer optical depths); depths in float64, at most `OPAQUE`.

    One running sum over all samples, minus its value at each ray's start: in float32 the difference of two large sums would
    lose the digits that late rays need. A depth that is NaN makes all later rays NaN, where compiled kernels lose its ray only.
    """
    running = torch.cat([tau.new_zeros(1), tau.cumsum(0)])[:-1]
    counts = torch.bincount(ray, minlength=rays)
    first = counts.cumsum(0) - counts
    return torch.exp(running[first[ray]] - running)
