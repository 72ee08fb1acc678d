"""The emission-absorption sum of volume rendering, over packed rays."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

OPAQUE = 1e3
"""Optical depths are cut here: exp(-1000) is 0 even in float64, and an infinite density would poison later rays' sums."""


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
    """Share of each ray's light that reaches its samples, from their optical depths in float64, `OPAQUE` at most.

    One running sum over all samples, from which each ray's own start is taken away: the difference of two large float32 sums
    would have lost the digits that a late ray needs.
    """
    running = torch.cat([tau.new_zeros(1), tau.cumsum(0)])[:-1]
    counts = torch.bincount(ray, minlength=rays)
    first = counts.cumsum(0) - counts
    return torch.exp(running[first[ray]] - running)
