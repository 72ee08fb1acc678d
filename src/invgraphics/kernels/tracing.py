"""Sphere tracing of a fused signed distance, dispatched as the operations in `invgraphics.kernels`."""

from __future__ import annotations

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.core.rays import Rays
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.types import Tracing, TracingLimits


def sdf_trace(rays: Rays, bounds: Bounds, field: FusedSDF, limits: TracingLimits) -> Tracing:
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
