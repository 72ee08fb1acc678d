"""Gaussians of a ray composited front to back, each integrated by itself, as if none overlapped."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Rays
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.reference.gaussian_quadrature import Weights, phi, weighted_sums
from invgraphics.kernels.reference.gaussian_rays import MAX_DEVIATIONS, Intersections, Primitives, intersect

Axes = Float[Tensor, "3"] | Float[Tensor, "n 3"] | None
"""Directions along which centres are sorted, of all rays or of each; ``None`` sorts by the distance of the largest response."""


def gaussian_composites(primitives: Primitives, rays: Rays, axes: Axes, extra: int = 0) -> Float[Tensor, "n c"]:
    """See `invgraphics.kernels.gaussians.gaussian_composites`."""
    found = intersect(primitives, rays)
    weights = composite_in_order(found, rays, primitives.opacity == "splat", depth_order(found, axes), extra > 0)
    return weighted_sums(primitives, rays, found, weights, extra)


def composite_in_order(
    intersections: Intersections, rays: Rays, splats: bool, order: Int[Tensor, " p"], with_distances: bool
) -> Weights:
    """Composite front to back: w_i = alpha_i times the product of (1 - alpha_j) before it, alpha_i = 1 - exp(-tau_i).

    Args:
        intersections: Gaussians on rays.
        rays: with near and far.
        splats: whether depths are those of splats, which no near or far plane cuts.
        order: of the intersections, by ray, then front to back.
        with_distances: whether weights times distance are returned too.
    """
    near, far = rays.near[intersections.ray], rays.far[intersections.ray]
    t, sigma, depth = intersections.t, intersections.sigma, intersections.optical_depth
    if not splats:
        start, end = (
            ((limit - t) / sigma).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
            for limit in (near, far.minimum((t + MAX_DEVIATIONS * sigma).detach()))
        )
        depth = depth * (phi(end) - phi(start)).clamp_min(0)  # of a ray that misses, far < near
    composite = choose("composite", t)
    ordered, _, _ = composite(depth[order], t.new_zeros(len(t), 0), intersections.ray, len(rays))
    weights = ordered[order.argsort()]
    return weights, weights * t.clamp(near, far) if with_distances else None


@torch.no_grad()
def depth_order(intersections: Intersections, axes: Axes) -> Int[Tensor, " p"]:
    """Sort intersections by ray, then front to back."""
    key = intersections.t
    if axes is not None:
        key = (intersections.offset * (axes if axes.dim() == 1 else axes[intersections.ray])).sum(dim=1)
    order = key.argsort(stable=True)
    return order[intersections.ray[order].argsort(stable=True)]
