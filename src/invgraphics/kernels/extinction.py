"""What the opacity of a 3D Gaussian says about the light that it absorbs: readings of one parameter."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.field import Gaussians
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN

Opacity = Literal["peak", "physical", "extinction", "splat"]
"""What a primitive's opacity *a* means.

- ``peak``: the optical depth of the whole line is ``-ln(1 - a) G``, so that a ray through the centre has alpha *a* from any
  side. No density in space does that: each ray sees another one.
- ``physical``: one density in space, the one whose extinction (optical depth over all lines of a direction), averaged over
  directions, is that of ``peak``; long axes look denser from their ends. For a sphere the two are the same.
- ``extinction``: one density in space as well, whose optical depth along the shortest axis, from which a Gaussian looks
  largest, is that of ``peak``. The total over all parallel lines is the same for every direction, so that along another one
  the optical depth is ``θ 2π √(λ1 λ2) / I2(Σ')`` for ``θ = -ln(1 - a)``, where λ1 and λ2 are the larger eigenvalues of the
  covariance, Σ' is its projection and ``I2(Σ') = 2π √det Σ'`` (Celarek et al. 2025, the formulation ``Ots`` of their code,
  whose θ has no upper limit): never less than θ.
- ``splat``: alpha is ``a G``, as splatters have it, which ignores that light is absorbed along the way.
"""

SMALLEST_DEPTH = ALPHA_MIN / 4
"""Optical depth below which a Gaussian is left out of a ray, unless a renderer says otherwise."""
THOMSEN = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, whose relative error is at most 1.1%."""


def strength(gaussians: Gaussians, opacity: Opacity) -> Float[Tensor, " m"]:
    """Factor that makes an optical depth of a response G: *a* for ``splat``, whose product with G is an alpha instead.

    For a density in space it is the optical depth per standard deviation along the ray, an inverse length; the density is
    ``strength / sqrt(2 pi) exp(-d² / 2)`` at the Mahalanobis distance d. Opacities count up to `ALPHA_MAX`, as in splatting.
    """
    if opacity == "splat":
        return gaussians.opacities
    peak = -torch.log1p(-gaussians.opacities.clamp_max(ALPHA_MAX))
    if opacity == "extinction":
        return peak / gaussians.scales.amin(dim=1)
    return peak * mean_inverse_scale(gaussians.scales) if opacity == "physical" else peak


def is_density(opacity: Opacity) -> bool:
    """Whether a reading is one density in space, so that optical depths grow with the chord through a Gaussian."""
    return opacity in ("physical", "extinction")


def without_self_attenuation(depth: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """Optical depth that gives a Gaussian alone the alpha ``depth``, up to `ALPHA_MAX`, instead of ``1 - exp(-depth)``.

    Light that a Gaussian emits is then not absorbed by that Gaussian itself: ``∫ sigma dt`` in place of
    ``∫ exp(-∫ sigma) sigma dt`` (Celarek et al. 2025). Others behind it see the matching transmittance ``1 - alpha``, so that
    the weights of a ray still add up to at most 1.
    """
    return -torch.log1p(-depth.clamp_max(ALPHA_MAX))


@torch.no_grad()
def reach(gaussians: Gaussians, opacity: Opacity, smallest: float = SMALLEST_DEPTH) -> Float[Tensor, " m"]:
    """Standard deviations beyond which no ray has an optical depth of ``smallest`` (``splat``: an alpha of `ALPHA_MIN`)."""
    largest = strength(gaussians, opacity)
    if is_density(opacity):
        largest = largest * gaussians.scales.amax(dim=1)
    limit = ALPHA_MIN if opacity == "splat" else smallest
    return (2 * torch.log((largest / limit).clamp_min(1.0))).sqrt()


def mean_inverse_scale(scales: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Mean of 1 / sigma over all directions, where sigma is the standard deviation along a line.

    It is the mean of ``sqrt(dᵀ Σ⁻¹ d)``, Carlson's R_G(1/s²), and by Cauchy's formula the ellipsoid's surface over
    4 pi s1 s2 s3, for which Thomsen's power mean is taken.
    """
    return scales.reciprocal().pow(THOMSEN).mean(dim=1).pow(1 / THOMSEN)
