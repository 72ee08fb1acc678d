"""Ray tracing of 3D Gaussians: their exact line integrals as overlapping densities."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.rays import Rays
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
        (n, 4 + extra), differentiable in the primitives and in the rays.
    """
    return choose("gaussian_integrals", primitives.means)(primitives, rays, steps, extra)
