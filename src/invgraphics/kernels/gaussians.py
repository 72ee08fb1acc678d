"""3D Gaussians as overlapping densities: exact line integrals along rays, and sums at points."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.field import Gaussians
from invgraphics.core.rays import Rays
from invgraphics.kernels.checks import check_columns, check_gaussians, check_rows, checked_rays
from invgraphics.kernels.dispatch import choose

if TYPE_CHECKING:
    from invgraphics.kernels.reference.gaussian_rays import Primitives


def gaussian_integrals(primitives: Primitives, rays: Rays, steps: int, extra: int = 0) -> Float[Tensor, "n c"]:
    """Light of rays through overlapping Gaussians: sums of each one's weight times (1, colour, distance, normal).

    Compiled for float32 on the CPU; gradients of distances and normals are the reference's.

    Args:
        primitives: what the rays meet.
        rays: with near and far; those of one origin that follow each other are searched for Gaussians together.
        steps: intervals of each ray.
        extra: columns after alpha and colour: 0, 1 (distance) or 4 (and the normal).

    Returns:
        (n, 4 + extra), differentiable in the primitives and in the rays' origins and directions.
    """
    return choose("gaussian_integrals", *_tensors(primitives), *checked_rays(rays))(primitives, rays, steps, extra)


def gaussian_composites(primitives: Primitives, rays: Rays, axes: Tensor | None, extra: int = 0) -> Float[Tensor, "n c"]:
    """Light of rays through Gaussians composited front to back, each integrated by itself as if none overlapped.

    Compiled for float32 on the CPU; gradients of distances and normals are the reference's.

    Args:
        primitives: what the rays meet.
        rays: as of `gaussian_integrals`.
        axes: directions along which centres are sorted, (3,) for all rays or (n, 3); ``None`` sorts by the distance of the
            largest response on each ray.
        extra: as of `gaussian_integrals`.

    Returns:
        (n, 4 + extra), differentiable in the primitives and in the rays' origins and directions, the order being fixed.
    """
    if axes is not None and axes.ndim > 1:
        check_rows("rays", len(rays), axes=axes)
    return choose("gaussian_composites", *_tensors(primitives), *checked_rays(rays), axes)(primitives, rays, axes, extra)


def gaussian_density(
    gaussians: Gaussians, position: Float[Tensor, "m 3"], eye: Float[Tensor, "m 3"] | None, smallest: float
) -> Float[Tensor, "m c"]:
    """Sum densities of Gaussians, and densities times colours, at points; a point that no Gaussian reaches has zeros.

    The density is the ``physical`` reading of the opacities (`invgraphics.kernels.extinction`). Compiled for float32 on the
    CPU; gradients in positions are the reference's.

    Args:
        gaussians: activated primitives.
        position: of m points; those with one eye should follow each other.
        eye: whence each point is looked at, which decides the Gaussians' colours there; ``None`` for densities alone.
        smallest: optical depth of a line below which a Gaussian is left out.

    Returns:
        (m, 4), or (m, 1) without ``eye``; differentiable in the Gaussians.
    """
    check_gaussians(gaussians)
    check_columns(3, position=position, eye=eye)
    check_rows("positions", len(position), eye=eye)
    return choose("gaussian_density", position, eye, *vars(gaussians).values())(gaussians, position, eye, smallest)


def _tensors(primitives: Primitives) -> tuple[Tensor, ...]:
    """What compiled kernels read of primitives."""
    p = primitives
    return p.means, p.whitening, p.strength, p.normals, p.sh, p.reach, p.radius
