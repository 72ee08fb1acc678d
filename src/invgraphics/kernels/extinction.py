"""What the opacity of a 3D Gaussian says about the light that it absorbs: readings of one parameter."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.field import Gaussians
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN

Opacity = Literal["peak", "physical", "splat"]
"""What a primitive's opacity *a* means.

- ``peak``: the optical depth of the whole line is ``-ln(1 - a) G``, so that a ray through the centre has alpha *a* from any
  side. No density in space does that: each ray sees another one.
- ``physical``: one density in space, the one whose extinction (optical depth over all lines of a direction), averaged over
  directions, is that of ``peak``; long axes look denser from their ends. For a sphere the two are the same.
- ``splat``: alpha is ``a G``, as splatters have it, which ignores that light is absorbed along the way.
"""

SMALLEST_DEPTH = ALPHA_MIN / 4
"""Optical depth below which a Gaussian is left out of a ray, unless a renderer says otherwise."""
THOMSEN = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, whose relative error is at most 1.1%."""


def strength(gaussians: Gaussians, opacity: Opacity) -> Float[Tensor, " m"]:
    """Factor that makes an optical depth of a response G: *a* for ``splat``, whose product with G is an alpha instead.

    For ``physical`` it is the optical depth per standard deviation along the ray, an inverse length; the density in space is
    ``strength / sqrt(2 pi) exp(-d² / 2)`` at the Mahalanobis distance d. Opacities count up to `ALPHA_MAX`, as in splatting.
    """
    if opacity == "splat":
        return gaussians.opacities
    peak = -torch.log1p(-gaussians.opacities.clamp_max(ALPHA_MAX))
    return peak * mean_inverse_scale(gaussians.scales) if opacity == "physical" else peak


@torch.no_grad()
def reach(gaussians: Gaussians, opacity: Opacity, smallest: float = SMALLEST_DEPTH) -> Float[Tensor, " m"]:
    """Standard deviations beyond which no ray has an optical depth of ``smallest`` (``splat``: an alpha of `ALPHA_MIN`)."""
    largest = strength(gaussians, opacity)
    if opacity == "physical":
        largest = largest * gaussians.scales.amax(dim=1)
    limit = ALPHA_MIN if opacity == "splat" else smallest
    return (2 * torch.log((largest / limit).clamp_min(1.0))).sqrt()


def mean_inverse_scale(scales: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Mean of 1 / sigma over all directions, where sigma is the standard deviation along a line.

    It is the mean of ``sqrt(dᵀ Σ⁻¹ d)``, Carlson's R_G(1/s²), and by Cauchy's formula the ellipsoid's surface over
    4 pi s1 s2 s3, for which Thomsen's power mean is taken.
    """
    return scales.reciprocal().pow(THOMSEN).mean(dim=1).pow(1 / THOMSEN)
