"""A fused signed distance at points and along rays, dispatched as the operations in `invgraphics.kernels`."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.core.rays import Rays
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.types import TracedRays, TracingLimits


def sdf_trace(rays: Rays, bounds: Bounds, field: FusedSDF, limits: TracingLimits) -> TracedRays:
    """Sphere tracing (Hart 1996) of a network over a hash grid or octaves: march, encode, evaluate and refine in one pass.

    Args:
        rays: with near and far set; rays whose far is not beyond near are left out.
        bounds: a box, whose unit cube the field is over.
        field: parameters of the signed distance.
        limits: steps and lengths.

    Returns:
        First hits and closest approaches. Not differentiable.
    """
    return choose("sdf_trace", rays.origins)(rays, bounds, field, limits)


def sdf_values(position: Float[Tensor, "n 3"], bounds: Bounds, field: FusedSDF) -> Float[Tensor, " n"]:
    """Signed distances at positions by a network over a hash grid or octaves: encode and evaluate in one pass.

    Args:
        position: where, local frame; outside the box, a grid's features are those of its boundary.
        bounds: a box, whose unit cube the field is over.
        field: parameters of the signed distance.

    Returns:
        Distances in local units, negative inside. Not differentiable.
    """
    return choose("sdf_values", position)(position, bounds, field)
