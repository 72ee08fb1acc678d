"""Operations on lattices (voxel grids, planes, lines), dispatched as those in `invgraphics.kernels`."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core import fused, lattice
from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels import types
from invgraphics.kernels.checks import check_cube, checked_rays
from invgraphics.kernels.dispatch import choose


def lattice_encode(
    unit: Float[Tensor, "m 3"],
    lattices: Sequence[lattice.Lattice],
    combine: lattice.Combination = "concat",
    sparse_gradients: bool = False,
) -> Float[Tensor, "m width"]:
    """Linear, bilinear and trilinear interpolation of features on lines, planes and voxel grids, combined per point.

    Compiled for float32 on the CPU and on NVIDIA GPUs; elsewhere the reference runs.

    Args:
        unit: positions in [0, 1]; those outside are clamped, NaN counts as 0.
        lattices: dense or linked lattices, features of ``unit``'s dtype and device.
        combine: concatenation, sum, VM or CP product (see `core.lattice.Combination`).
        sparse_gradients: allow gradients of features that are sparse tensors of the rows around the points, as torch's
            ``embedding`` has them: their cost does not grow with the lattice. On the CPU, of large lattices that are not
            factors of a product, unless the graph of the gradient is requested; all others stay dense.

    Returns:
        Features, differentiable twice in ``unit`` and in every lattice's features; the gradient along axes on which a position
        was clamped is zero. Widths: ``concat`` the sum of all channels, ``vm`` that of its pairs, ``sum`` and ``cp`` one
        lattice's channels.

    Raises:
        InputError: lattices that do not fit together or do not fit the positions.
    """
    lattice.check_lattices(unit, lattices, combine)
    return choose("lattice_encode", unit)(unit, lattices, combine, sparse_gradients)


def lattice_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: types.MarchSteps,
    field: fused.FusedLattice,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> types.March:
    """`kernels.ngp_march` for a field over lattices.

    Arguments and result as there; appearance and networks of colour are not looked at.
    """
    check_cube(occupied)
    return choose("lattice_march", *checked_rays(rays, start))(rays, occupied, bounds, steps, field, start, min_transmittance)


def lattice_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: types.MarchSteps,
    field: fused.FusedLattice,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """`kernels.ngp_render` for a field over lattices: voxels, tri-planes, VM and CP factors, with networks or without.

    Arguments and results as there. Not differentiable.
    """
    check_cube(occupied)
    render = choose("lattice_render", *checked_rays(rays))
    return render(rays, occupied, bounds, steps, field, min_transmittance, max_error, width)
