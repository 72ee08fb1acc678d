"""Density and transmittance along one ray through Gaussians of known optical depth, for plots."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Profile, Rays
from invgraphics.core.contributions import POINTS
from invgraphics.kernels.reference.gaussian_quadrature import phi

REACH = 4.0
"""Standard deviations to either side of the first and last Gaussian that a profile covers."""


def density_profile(
    t: Float[Tensor, " k"], sigma: Float[Tensor, " k"], optical_depth: Float[Tensor, " k"], rays: Rays
) -> Profile | None:
    """Density and transmittance profile of Gaussians as overlapping densities; ``None`` without any, or where one is flat.

    Args:
        t: distance of each one's largest response.
        sigma: standard deviation along the ray.
        optical_depth: optical depth of the whole line.
        rays: the one ray.
    """
    if not len(t) or not bool((sigma > 0).all()):
        return None
    low, high = (t - REACH * sigma).amin().maximum(rays.near[0]), (t + REACH * sigma).amax()
    # Evenly, and closely around every centre, since some are much thinner than others.
    even = torch.lerp(low, high, torch.linspace(0, 1, POINTS).to(t))
    close = (t[:, None] + sigma[:, None] * torch.linspace(-3, 3, 13).to(t)).flatten()
    at = torch.cat([even, close.clamp(low, high)]).sort().values
    bells = torch.exp(-0.5 * ((at[:, None] - t) / sigma).square()) / math.sqrt(2 * math.pi)
    return Profile(at, (bells * (optical_depth / sigma)).sum(dim=1), transmittance(at, t, sigma, optical_depth, rays))


def transmittance(
    at: Float[Tensor, " p"], t: Float[Tensor, " k"], sigma: Float[Tensor, " k"], optical_depth: Float[Tensor, " k"], rays: Rays
) -> Float[Tensor, " p"]:
    """Transmittance at distances ``at``, 1 before the near plane, through Gaussians of given optical depths."""
    passed = phi((at.maximum(rays.near[0])[:, None] - t) / sigma) - phi((rays.near[0] - t) / sigma)
    return torch.exp(-(passed * optical_depth).sum(dim=1))


def mean_distances(
    moment: Float[Tensor, " p"] | None, order: Int[Tensor, " k"], weight: Float[Tensor, " k"], t: Float[Tensor, " k"]
) -> Float[Tensor, " k"]:
    """Mean distance of the light of each of k Gaussians, its largest response where it gives none.

    Args:
        moment: weights times distances of all intersections.
        order: those that are listed.
        weight: their weights.
        t: distances of their largest responses.
    """
    assert moment is not None
    return torch.where(weight > 0, moment[order] / weight.clamp_min(torch.finfo(weight.dtype).tiny), t)
