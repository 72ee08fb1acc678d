"""Search for the nearest points of positions."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.checks import check_columns
from invgraphics.kernels.dispatch import choose


def near_points(
    position: Float[Tensor, "m 3"], points: Float[Tensor, "n 3"], count: int, radius: float
) -> tuple[Int[Tensor, "m count"], Float[Tensor, "m count"]]:
    """The ``count`` nearest points of each position within ``radius``, nearest first, by lists of the points of each cell.

    Compiled for float32 on the CPU; elsewhere the reference runs, by brute force.

    Args:
        position: where to look.
        points: among which; ties go to the lower index.
        count: most neighbours of a position.
        radius: largest distance, > 0.

    Returns:
        Indices of points, -1 where there are fewer; squared distances, infinite there. Not differentiable.
    """
    check_columns(3, position=position, points=points)
    return choose("near_points", position, points)(position, points, count, radius)
