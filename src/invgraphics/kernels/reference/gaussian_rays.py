"""Anisotropic Gaussians as a ray meets them: restricted to a line each is a Gaussian again, with closed-form integrals.

In the frame where a Gaussian is the unit one, with ``x`` the vector from the ray's origin to its centre and ``d`` the ray's
direction, its response along the ray is ``G exp(-(t - t*)² / 2 sigma²)`` with ``t* = x.d / d.d``, ``sigma = 1 / |d|`` and
``G = exp(-|x - t* d|² / 2)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import Gaussians, Rays, harmonics
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.extinction import Opacity, is_density, reach, strength, without_self_attenuation
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN

MAX_DEVIATIONS = 8.0
"""Standard deviations beyond which nothing of a Gaussian is left, even in float64."""
ROUNDING = 1e-5
"""Relative error allowed for in the search, which squares and subtracts distances in float32."""
MOST_TESTED = 1 << 18
"""Ray-Gaussian distances that are looked at together: so many that they stay in the cache."""


@dataclass(frozen=True, eq=False)
class Primitives:
    """m Gaussians with their precomputed, ray-independent quantities.

    Attributes:
        means: centres.
        whitening: takes offsets to the frame where the Gaussian is the unit one, diag(1/s) Rᵀ.
        strength: *a* for ``splat``, else what a response is multiplied with to be an optical depth (a density: per length).
        normals: shortest axes, of either sign.
        sh: coefficients of the colour.
        rgb: colours as seen from the only origin that rays have; ``None`` where they have several.
        reach: standard deviations beyond which a Gaussian is left out.
        radius: the same as a length, along the longest axis.
        opacity: the reading that ``strength`` follows.
        self_attenuation: whether a Gaussian absorbs its own light; see `kernels.extinction.without_self_attenuation`.
    """

    means: Float[Tensor, "m 3"]
    whitening: Float[Tensor, "m 3 3"]
    strength: Float[Tensor, " m"]
    normals: Float[Tensor, "m 3"]
    sh: Float[Tensor, "m c 3"]
    rgb: Float[Tensor, "m 3"] | None
    reach: Float[Tensor, " m"]
    radius: Float[Tensor, " m"]
    opacity: Opacity
    self_attenuation: bool = True


@dataclass(frozen=True, eq=False)
class Intersections:
    """p intersections of rays with Gaussians, packed by ray.

    Attributes:
        ray: index of the ray, non-decreasing.
        gaussian: index of the Gaussian.
        offset: from the ray's origin to the centre.
        t: distance of the largest response.
        sigma: standard deviation of the response along the ray.
        optical_depth: optical depth of the whole line; for ``splat`` the one whose alpha is ``a G``.
    """

    ray: Int[Tensor, " p"]
    gaussian: Int[Tensor, " p"]
    offset: Float[Tensor, "p 3"]
    t: Float[Tensor, " p"]
    sigma: Float[Tensor, " p"]
    optical_depth: Float[Tensor, " p"]

    def __len__(self) -> int:
        return len(self.ray)


def precompute(
    gaussians: Gaussians,
    opacity: Opacity,
    smallest: float,
    origin: Float[Tensor, 3] | None = None,
    self_attenuation: bool = True,
) -> Primitives:
    """Precompute whitening transforms, strengths and reaches of Gaussians, for any ray.

    Args:
        gaussians: activated primitives; opacities count up to `ALPHA_MAX`, as in splatting.
        opacity: how opacities are read.
        smallest: optical depth below which a Gaussian is left out of a ray; ``splat`` has its own limit, `ALPHA_MIN`.
        origin: where all rays begin, if that is one point.
        self_attenuation: whether a Gaussian absorbs its own light; ``splat`` alphas are none of an absorbing Gaussian.
    """
    axes, scales = quaternion_to_matrix(gaussians.quaternions), gaussians.scales
    deviations = reach(gaussians, opacity, smallest)
    shortest = scales.argmin(dim=1)[:, None, None].expand(-1, 3, 1)
    return Primitives(
        means=gaussians.means,
        whitening=axes.transpose(1, 2) / scales[:, :, None],
        strength=strength(gaussians, opacity),
        normals=axes.gather(2, shortest)[:, :, 0],
        sh=gaussians.sh,
        rgb=None if origin is None else _colour(gaussians.sh, gaussians.means - origin),
        reach=deviations,
        radius=deviations * scales.detach().amax(dim=1),
        opacity=opacity,
        self_attenuation=self_attenuation,
    )


def intersect(primitives: Primitives, rays: Rays) -> Intersections:
    """Intersect rays with Gaussians within their reach, differentiably in Gaussians and rays."""
    ray, gaussian = choose("gaussian_pairs", primitives.means, rays.origins)(primitives, rays)
    table = torch.cat([primitives.means, primitives.whitening.flatten(1), primitives.strength[:, None]], dim=1)
    # index_select has a faster gradient than indexing.
    means, whitening, factor = table.index_select(0, gaussian).split([3, 9, 1], dim=1)
    offset = means - rays.origins.index_select(0, ray)
    t, sigma, squared = _restrict_to_rays(whitening.view(-1, 3, 3), offset, rays.directions.index_select(0, ray))
    response = factor[:, 0] * torch.exp(-0.5 * squared)
    if primitives.opacity != "splat":
        depth = response * sigma if is_density(primitives.opacity) else response
        depth = depth if primitives.self_attenuation else without_self_attenuation(depth)
    else:
        seen = (response >= ALPHA_MIN) & (t > rays.near[ray])
        depth = torch.where(seen, -torch.log1p(-response.clamp_max(ALPHA_MAX)), 0.0)
    return Intersections(ray, gaussian, offset, t, sigma, depth)


def colours(primitives: Primitives, intersections: Intersections) -> Float[Tensor, "p 3"]:
    """Colour of each intersection: max(0, SH + 0.5) in the direction of the centre, as in splatting."""
    if primitives.rgb is not None:
        return primitives.rgb.index_select(0, intersections.gaussian)
    return _colour(primitives.sh.index_select(0, intersections.gaussian), intersections.offset)


def normals(primitives: Primitives, intersections: Intersections, rays: Rays) -> Float[Tensor, "p 3"]:
    """Normal of each intersection: the Gaussian's shortest axis, turned against the ray."""
    axes = primitives.normals.index_select(0, intersections.gaussian)
    away = (axes * rays.directions.index_select(0, intersections.ray)).sum(dim=1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def _colour(sh: Float[Tensor, "p c 3"], offset: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
    return harmonics.colour(sh, normalize(offset, dim=1))


def _restrict_to_rays(
    whitening: Float[Tensor, "*p 3 3"], offset: Float[Tensor, "*p 3"], direction: Float[Tensor, "*p 3"]
) -> tuple[Float[Tensor, "*p"], Float[Tensor, "*p"], Float[Tensor, "*p"]]:
    """Restrict Gaussians to rays: distance of the peak, standard deviation, squared Mahalanobis distance from the centre."""
    x = (whitening * offset[..., None, :]).sum(dim=-1)
    d = (whitening * direction[..., None, :]).sum(dim=-1)
    rate = d.square().sum(dim=-1)
    t = (x * d).sum(dim=-1) / rate
    return t, rate.rsqrt(), (x - t[..., None] * d).square().sum(dim=-1)


@torch.no_grad()
def gaussian_pairs(primitives: Primitives, rays: Rays) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Find pairs of rays and Gaussians within the Gaussians' reach, sorted by ray, then by Gaussian.

    Pairs whose peak is more than `MAX_DEVIATIONS` before near or behind far are left out.
    """
    some = _in_cone(primitives, rays)
    centres, exact = primitives.means[some], 1 - ROUNDING
    # A ray meets a Gaussian's sphere where |c - o|² - ((c - o).d)² <= r²; terms of one of the two are computed once.
    of_sphere = exact * centres.square().sum(dim=1) - primitives.radius[some].square()
    found, first = [(some[:0], some[:0])], 0
    for part in rays.chunks(max(1, MOST_TESTED // max(1, len(some)))) if len(some) else ():
        along = part.directions @ centres.T - (part.origins * part.directions).sum(dim=1, keepdim=True)
        of_ray = exact * part.origins.square().sum(dim=1, keepdim=True)
        across = (of_sphere + of_ray).addmm_(part.origins, centres.T, alpha=-2 * exact)
        ray, chosen = (across <= along.square_()).nonzero(as_tuple=True)
        gaussian = some[chosen]
        offset = primitives.means[gaussian] - part.origins[ray]
        t, sigma, squared = _restrict_to_rays(primitives.whitening[gaussian], offset, part.directions[ray])
        kept = squared < primitives.reach[gaussian].square()
        kept &= (t + MAX_DEVIATIONS * sigma > part.near[ray]) & (t - MAX_DEVIATIONS * sigma < part.far[ray])
        found.append((ray[kept] + first, gaussian[kept]))
        first += len(part)
    return torch.cat([ray for ray, _ in found]), torch.cat([gaussian for _, gaussian in found])


def _in_cone(primitives: Primitives, rays: Rays) -> Int[Tensor, " s"]:
    """Cull Gaussians: visible ones whose bounding sphere meets the cone around rays with one origin."""
    seen = primitives.reach > 0
    if len(rays) and bool((rays.origins == rays.origins[0]).all()):
        axis = normalize(rays.directions.mean(dim=0), dim=0)
        opening = torch.acos((rays.directions @ axis).min().clamp(-1, 1))
        offset = primitives.means - rays.origins[0]
        distance = offset.norm(dim=1).clamp_min(torch.finfo(offset.dtype).tiny)
        aside = torch.acos((offset @ axis / distance).clamp(-1, 1))
        # Twice the rounding of an arc cosine near 1, which is the square root of a number's.
        angle = opening + torch.asin((primitives.radius / distance).clamp_max(1.0)) + 2 * ROUNDING**0.5
        seen &= (aside <= angle) | (distance <= primitives.radius)
    return seen.nonzero()[:, 0]
