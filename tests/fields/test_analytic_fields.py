"""The oracles themselves: closed-form optical depths against numerical integration of their densities."""

import math

import pytest
import torch

from invgraphics.core import Quantity, Rays, Samples, harmonics
from invgraphics.fields.analytic import Box, GaussianBlob, Slab, Sphere

COVARIANCE = torch.tensor([[0.5, 0.1, 0.0], [0.1, 0.2, -0.05], [0.0, -0.05, 0.3]])
FIELDS = {
    "slab": lambda: Slab(1.7, -0.4, 0.6, axis=(1, 2, -1)),
    "sphere": lambda: Sphere(2.3, 0.8, centre=(0.1, -0.2, 0.3)),
    "box": lambda: Box(1.3, (0.5, 0.7, 0.3), centre=(0.1, -0.2, 0.3)),
    "blob": lambda: GaussianBlob(1.4, COVARIANCE, centre=(0.1, -0.2, 0.3)),
    "round blob": lambda: GaussianBlob(1.4, 0.2),
}


def _rays(n: int = 12) -> Rays:
    directions = torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=1)
    origins = -2.5 * directions + 0.4 * torch.randn(n, 3, dtype=torch.float64)
    # Some rays start or end inside.
    near = torch.linspace(0.0, 3.0, n, dtype=torch.float64)
    return Rays.make(origins, directions).within(near, near + 1 + 3 * torch.rand(n, dtype=torch.float64))


@pytest.mark.parametrize("name", FIELDS)
def test_optical_depth_is_the_integral_of_the_density(name):
    field = FIELDS[name]().double()
    rays = _rays()
    depths = field.optical_depth(rays).detach()
    assert float(depths.max()) > 0.3
    for i, depth in enumerate(depths.tolist()):
        t = torch.linspace(float(rays.near[i]), float(rays.far[i]), 200_001, dtype=torch.float64)
        values = field.density_at(rays.origins[i] + t[:, None] * rays.directions[i])
        # A hard edge costs the trapezoid rule up to half a step of density.
        assert depth == pytest.approx(torch.trapezoid(values, t).item(), abs=1e-6 if "blob" in name else 2e-4)


def test_unbounded_and_parallel_rays():
    rays = Rays.make(torch.tensor([[0.0, 0, 0], [0, 0, 5], [0, 0, -5]]), torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]]))
    slab = Slab(0.5, -1.0, 1.0)
    depth = slab.optical_depth(rays)
    assert depth[0] > 1e6
    torch.testing.assert_close(depth[1:].detach(), torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(Sphere(0.5, 1.0).optical_depth(rays).detach(), torch.tensor([0.5, 0.0, 1.0]))
    blob = GaussianBlob(0.5, 0.3).optical_depth(rays).detach()
    whole = 0.5 * math.sqrt(2 * math.pi * 0.3)
    torch.testing.assert_close(blob, torch.tensor([whole / 2, whole * math.exp(-25 / 0.6), whole]))


@pytest.mark.parametrize("name", ["sphere", "box"])
def test_distances_gradients_and_normals_agree(name):
    solid = FIELDS[name]().double()
    position = torch.randn(1000, 3, dtype=torch.float64, requires_grad=True)
    values = solid.query(Samples.at(position), solid.provides)
    assert values.sdf is not None
    assert values.density is not None
    (gradient,) = torch.autograd.grad(values.sdf.sum(), position)
    torch.testing.assert_close(values.gradient, gradient)
    torch.testing.assert_close(values.normal, gradient)
    assert 10 < int((values.density > 0).sum()) < 990
    assert torch.equal(values.density > 0, values.sdf <= 0)


def test_distance_of_a_box_is_that_to_its_nearest_point():
    box = Box(1.0, (0.5, 0.7, 0.3)).double()
    points = (torch.rand(200_000, 3, dtype=torch.float64) * 2 - 1) * box.half_edges
    axis = torch.randint(3, (len(points),))
    sides = torch.arange(len(points)), axis
    points[sides] = points[sides].sign() * box.half_edges[axis]
    position = torch.randn(20, 3, dtype=torch.float64)
    nearest = torch.cdist(position, points).amin(dim=1)
    inside = (position.abs() <= box.half_edges).all(dim=1)
    expected = torch.where(inside, -nearest, nearest)
    torch.testing.assert_close(box.sdf_at(position), expected, atol=1e-2, rtol=0)


def test_colours_are_constant_or_follow_the_direction():
    direction = torch.nn.functional.normalize(torch.randn(5, 3), dim=1)
    samples = Samples.at(torch.zeros(5, 3), direction)
    plain = Slab(1.0, -1, 1, colour=(0.2, 0.4, 0.6)).query(samples, Quantity.RADIANCE)
    assert plain.density is None
    torch.testing.assert_close(plain.radiance, torch.tensor([[0.2, 0.4, 0.6]]).expand(5, 3))
    sh = 0.1 * torch.randn(9, 3)
    shiny = Slab(1.0, -1, 1, colour=sh).query(samples, Quantity.RADIANCE)
    torch.testing.assert_close(shiny.radiance, harmonics.basis(direction, 2) @ sh + 0.5)


@pytest.mark.parametrize("name", FIELDS)
def test_optical_depth_is_differentiable_in_the_parameters(name):
    field = FIELDS[name]().double()
    names = [key for key in dict(field.named_parameters()) if key not in ("colour",)]
    values = tuple(field.get_parameter(key).detach().requires_grad_() for key in names)
    rays = _rays(4)

    def depth(*changed):
        swapped = {f"field.{key}": value for key, value in zip(names, changed, strict=True)}
        return torch.func.functional_call(_Depth(field), swapped, (rays,))

    assert torch.autograd.gradcheck(depth, values)


class _Depth(torch.nn.Module):
    def __init__(self, field):
        super().__init__()
        self.field = field

    def forward(self, rays):
        return self.field.optical_depth(rays)
