"""A fused signed distance at points, along rays and on a grid, dispatched as the operations in `invgraphics.kernels`."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.core.rays import Rays
from invgraphics.kernels.checks import check_columns, check_rows, check_table, checked_rays
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
    check_table(field.table, field.grid)
    return choose("sdf_trace", *checked_rays(rays), field.table)(rays, bounds, field, limits)


def sdf_radiance(
    position: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], bounds: Bounds, field: FusedSDF
) -> Float[Tensor, "n 3"]:
    """Radiance of a signed distance's field by two networks over hash grids or octaves: encode and evaluate in one pass.

    Args:
        position: where, local frame.
        direction: of view, unit length.
        bounds: a box, whose unit cube the field is over.
        field: parameters of the signed distance and of its ``colour``, which it has to have.

    Returns:
        Radiance in the field's colour space. Not differentiable.
    """
    check_columns(3, position=position, direction=direction)
    check_rows("positions", len(position), direction=direction)
    check_table(field.table, field.grid)
    return choose("sdf_radiance", position, direction, field.table)(position, direction, bounds, field)


def sdf_skip(
    rays: Rays, bounds: Bounds, distances: Float[Tensor, "rx ry rz"], margin: float, least: float, factor: float = 1.0
) -> Float[Tensor, " n"]:
    """Empty-space skipping by a grid of signed distances: sphere tracing (Hart 1996) with one read of memory per step.

    In a cell whose centre is v from the surface, a point that is r from the centre is at least v - r from it, as far as the
    distances are true ones.

    Args:
        rays: with near and far set; of those whose far is not beyond near, far is returned.
        bounds: a box, of which each cell is a part.
        distances: signed distances at the cells' centres, local units.
        margin: distance that is kept from the surface.
        least: the first step that is not longer than this is left out.
        factor: of each step, below 1 for distances that grow faster than the way.

    Returns:
        Distance along each ray, from near to far, before which no surface is nearer than ``margin``. Not differentiable.
    """
    return choose("sdf_skip", *checked_rays(rays), distances)(rays, bounds, distances, margin, least, factor)


def sdf_values(position: Float[Tensor, "n 3"], bounds: Bounds, field: FusedSDF) -> Float[Tensor, " n"]:
    """Signed distances at positions by a network over a hash grid or octaves: encode and evaluate in one pass.

    Args:
        position: where, local frame; outside the box, a grid's features are those of its boundary.
        bounds: a box, whose unit cube the field is over.
        field: parameters of the signed distance.

    Returns:
        Distances in local units, negative inside. Not differentiable.
    """
    check_columns(3, position=position)
    check_table(field.table, field.grid)
    return choose("sdf_values", position, field.table)(position, bounds, field)
