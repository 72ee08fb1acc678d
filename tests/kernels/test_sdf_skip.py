"""Empty-space skipping by a grid of distances against true distances, and the compiled one against the plain loop."""

from types import ModuleType

import pytest
import torch
from torch import Tensor

from invgraphics.core import Bounds, Rays
from invgraphics.kernels import numba, reference
from invgraphics.testing import toy_scene

BOUNDS = Bounds(torch.tensor([-1.0, -0.9, -1.2]), torch.tensor([1.0, 1.1, 1.0]))
BALLS = ((0.3, (0.4, 0.1, 0.0)), (0.2, (-0.5, 0.6, -0.6)), (0.02, (0.0, -0.6, 0.5)))
KERNELS = pytest.mark.parametrize("kernels", [reference, numba], ids=["reference", "numba"])


def true_distance(position: Tensor) -> Tensor:
    """Of three balls, one of them smaller than any cell."""
    return torch.stack([(position - position.new_tensor(centre)).norm(dim=-1) - radius for radius, centre in BALLS]).amin(dim=0)


def grid(resolution: tuple[int, int, int]) -> Tensor:
    """True distances at the cells' centres."""
    axes = [(torch.arange(count) + 0.5) / count for count in resolution]
    centres = BOUNDS.from_unit(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1))
    torch.testing.assert_close(BOUNDS.cell_centres(resolution), centres.flatten(0, 2))
    return true_distance(centres)


def around() -> Rays:
    """Rays of two cameras around the box, some of which miss it."""
    rays = Rays.cat([view.camera.resized(50, 50).rays() for view in toy_scene(views=2, size=8).train])
    return BOUNDS.clip(rays)


@KERNELS
@pytest.mark.parametrize("margin", [0.0, 0.05])
@pytest.mark.parametrize("resolution", [(9, 9, 9), (20, 12, 31)])
def test_no_surface_is_nearer_than_the_margin_before_the_start(
    kernels: ModuleType, margin: float, resolution: tuple[int, int, int]
) -> None:
    rays = around()
    starts = kernels.sdf_skip(rays, BOUNDS, grid(resolution), margin, 0.01, 1.0)
    inside = rays.far > rays.near
    assert 20 < int((~inside).sum()) < len(rays) - 1000, "rays that miss the box, and others"
    assert torch.equal(starts[~inside], rays.far[~inside])
    rays, starts = rays[inside], starts[inside]
    assert bool(((starts >= rays.near) & (starts <= rays.far)).all())
    along = true_distance(rays.at(torch.lerp(rays.near[:, None], starts[:, None], torch.linspace(0, 1, 300))))
    assert float(along.amin()) > margin - 1e-4
    # Rays that are not near any ball leave the box; the others begin near one, or where a cell does not say more.
    assert float((starts == rays.far).float().mean()) > 0.2
    edge = float(((BOUNDS.hi - BOUNDS.lo) / torch.tensor(resolution)).norm())
    left = true_distance(rays.at(starts))[starts < rays.far]
    assert float(left.amax()) < edge + margin + 0.01


@pytest.mark.parametrize("factor", [1.0, 0.6])
def test_equals_the_plain_loop_in_float64(factor: float) -> None:
    rays, distances = around(), grid((14, 17, 11))
    ours = numba.sdf_skip(rays, BOUNDS, distances, 0.02, 0.01, factor)
    double = rays.to(torch.float64), BOUNDS.to(torch.float64), distances.double()
    true = reference.sdf_skip(*double, 0.02, 0.01, factor)
    # A step may end on either side of a cell's face, or of the shortest step.
    assert float(((ours - true).abs() < 1e-4).float().mean()) > 0.99


def test_a_smaller_factor_takes_shorter_steps() -> None:
    rays, distances = around(), grid((14, 17, 11))
    whole, part = (reference.sdf_skip(rays, BOUNDS, distances, 0.0, 0.01, factor) for factor in (1.0, 0.5))
    # Not every ray: one that steps further may come to a place of which the grid says less.
    assert float((part < whole - 0.01).float().mean()) > 0.1
    assert float((part > whole + 0.01).float().mean()) < 0.05


@KERNELS
def test_rays_inside_and_distances_that_are_none_begin_where_they_did(kernels: ModuleType) -> None:
    rays = around()
    for value in (-1.0, torch.nan):
        starts = kernels.sdf_skip(rays, BOUNDS, torch.full((4, 4, 4), value), 0.0, 0.0, 1.0)
        torch.testing.assert_close(starts, torch.minimum(rays.near, rays.far))
    assert kernels.sdf_skip(rays[:0], BOUNDS, torch.ones(4, 4, 4), 0.0, 0.0, 1.0).shape == (0,)
