"""The region of a scene: its map to the unit cube and the interval it leaves of a ray."""

import pytest
import torch

from invgraphics.core import Bounds, Rays
from invgraphics.core.bounds import CONTRACTED_FAR, Space, contract, contract_jacobian, uncontract

F64 = torch.float64


def bounds(space: str = "box", near: float = 0.1) -> Bounds:
    return Bounds(torch.tensor([-1.0, -2.0, 0.5], dtype=F64), torch.tensor([3.0, 1.0, 1.5], dtype=F64), space, near)


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_unit_cube_and_back(space: str) -> None:
    region = bounds(space)
    points = torch.randn(200, 3, dtype=F64) * (20 if space == "contracted" else 2)
    unit = region.to_unit(points)
    torch.testing.assert_close(region.from_unit(unit), points)
    if space == "contracted":
        assert bool(((unit > 0) & (unit < 1)).all())
        assert bool(region.contains(points).all())
    else:
        inside = ((unit >= 0) & (unit <= 1)).all(dim=1)
        assert torch.equal(region.contains(points), inside)
        assert 0 < int(inside.sum()) < 200


def test_corners_of_the_box() -> None:
    region = bounds()
    torch.testing.assert_close(region.to_unit(region.lo), torch.zeros(3, dtype=F64))
    torch.testing.assert_close(region.to_unit(region.hi), torch.ones(3, dtype=F64))
    torch.testing.assert_close(bounds("contracted").to_unit(region.centre), torch.full((3,), 0.5, dtype=F64))


def test_vertices_of_a_grid_lie_in_its_box() -> None:
    """Also where rounding takes the corners of the unit cube out of it, as in every third box."""
    grids = torch.Generator().manual_seed(0)
    out = 0
    for _ in range(50):
        lo = 2 * torch.rand(3, generator=grids) - 2
        region = Bounds(lo, lo + 0.5 + torch.rand(3, generator=grids))
        out += not bool(region.contains(region.from_unit(torch.tensor([[0.0, 0, 0], [1, 1, 1]]))).all())
        vertices = region.vertices((3, 2, 4))
        assert bool(region.contains(vertices).all())
        torch.testing.assert_close(vertices[[0, -1]], torch.stack([region.lo, region.hi]))
        torch.testing.assert_close(vertices.view(3, 2, 4, 3)[1, 1, 2], lo + (region.hi - lo) * torch.tensor([0.5, 1, 2 / 3]))
    assert out > 5


def test_contraction_is_equation_10_of_mipnerf360() -> None:
    inside, outside = torch.tensor([[0.3, -0.2, 0.1]], dtype=F64), torch.tensor([[0.0, 3.0, 4.0]], dtype=F64)
    assert torch.equal(contract(inside), inside)
    torch.testing.assert_close(contract(outside), (2 - 1 / 5) * outside / 5)
    assert float(contract(outside * 1e6).norm()) == pytest.approx(2.0)
    points = torch.randn(100, 3, dtype=F64) * 3
    torch.testing.assert_close(uncontract(contract(points)), points)


def test_contraction_has_gradients_everywhere() -> None:
    points = torch.cat([torch.zeros(1, 3), torch.randn(20, 3), torch.randn(5, 3) * 100]).double().requires_grad_()
    assert torch.autograd.gradcheck(contract, (points,))


def test_clip_finds_the_part_inside() -> None:
    region = bounds()
    origins = torch.randn(300, 3, dtype=F64) * 3
    rays = Rays.make(origins, torch.nn.functional.normalize(region.centre - origins + torch.randn(300, 3, dtype=F64), dim=1))
    clipped = region.clip(rays)
    t = torch.linspace(0, 20, 4001, dtype=F64).expand(300, -1)
    inside = region.contains(rays.at(t)) & (t >= region.near)
    within = (t >= clipped.near[:, None]) & (t <= clipped.far[:, None])
    assert int(inside.any(dim=1).sum()) > 50
    assert int((~inside.any(dim=1)).sum()) > 20
    # The clipped interval and the brute-force one may differ by a grid point at either end.
    assert int((inside != within).sum(dim=1).max()) <= 2
    assert bool((clipped.far >= clipped.near).all())


def test_clip_axis_parallel_rays() -> None:
    region = bounds()
    directions = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], dtype=F64)
    origins = torch.tensor([[-5.0, 0, 1.0], [0, 0, 9.0], [9.0, -5.0, 1.0]], dtype=F64)
    clipped = region.clip(Rays.make(origins, directions))
    torch.testing.assert_close(clipped.near[:2], torch.tensor([4.0, 7.5], dtype=F64))
    torch.testing.assert_close(clipped.far[:2], torch.tensor([8.0, 8.5], dtype=F64))
    assert clipped.far[2] == clipped.near[2]


def test_contracted_rays_end_far_away() -> None:
    region = bounds("contracted", near=0.3)
    clipped = region.clip(Rays.make(torch.zeros(1, 3, dtype=F64), torch.tensor([[0.0, 0, 1.0]], dtype=F64)))
    assert float(clipped.near) == 0.3
    assert float(clipped.far) == CONTRACTED_FAR * 2.0


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_covariances_go_through_the_jacobian_that_autograd_finds(space: Space) -> None:
    bounds = Bounds(torch.tensor([-1.0, -2.0, -0.5]).double(), torch.tensor([1.5, 1.0, 2.0]).double(), space)
    position = torch.randn(8, 3, dtype=torch.float64) * 3
    root = torch.randn(8, 3, 3, dtype=torch.float64)
    mapped = bounds.unit_covariance(position, root @ root.mT)
    for point, factor, result in zip(position, root, mapped, strict=True):
        jacobian = torch.autograd.functional.jacobian(bounds.to_unit, point)
        torch.testing.assert_close(result, jacobian @ factor @ factor.T @ jacobian.T)
    moving = lambda p: bounds.unit_covariance(p, root @ root.mT)  # noqa: E731
    assert torch.autograd.gradcheck(moving, (position.requires_grad_(),))


def test_the_contraction_s_jacobian_is_the_identity_up_to_the_unit_sphere() -> None:
    direction = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    eye = torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    assert torch.equal(contract_jacobian(0.999 * direction), eye)
    torch.testing.assert_close(contract_jacobian((1 + 1e-9) * direction), eye, atol=1e-8, rtol=0)
    assert torch.equal(contract_jacobian(torch.zeros(1, 3, dtype=torch.float64)), eye[:1])
