"""A moved field must look the same from a moved camera, and follow the closed form of the moved object."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.core import Context, Points, Quantity, Rays, Samples
from invgraphics.core.field import Encoding
from invgraphics.errors import InputError
from invgraphics.fields.analytic import GaussianBlob, Slab, Sphere
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.fields.transformed import Transformed

SCALE = 1.7
ROTATION = torch.from_numpy(Rotation.random(random_state=2).as_matrix())
SHIFT = torch.tensor([0.4, -1.0, 2.0], dtype=torch.float64)
SIMILARITY = torch.eye(4, dtype=torch.float64)
SIMILARITY[:3, :3], SIMILARITY[:3, 3] = SCALE * ROTATION, SHIFT


def _moved(points: torch.Tensor) -> torch.Tensor:
    return SCALE * points @ ROTATION.T + SHIFT


def _samples(m: int = 40) -> Samples:
    direction = torch.nn.functional.normalize(torch.randn(m, 3, dtype=torch.float64), dim=1)
    return Samples.at(_moved(torch.randn(m, 3, dtype=torch.float64)), direction)


def test_a_moved_sphere_is_the_sphere_over_there():
    centre = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    sh = 0.1 * torch.randn(4, 3)
    moved = Transformed(Sphere(2.0, 0.9, centre, sh).double(), SIMILARITY)
    there = Sphere(2.0 / SCALE, 0.9 * SCALE, _moved(centre)).double()
    samples = _samples()
    values, expected = moved.query(samples, moved.provides), there.query(samples, there.provides)
    torch.testing.assert_close(values.density, expected.density)
    torch.testing.assert_close(values.sdf, expected.sdf, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(values.normal, expected.normal, atol=1e-6, rtol=1e-6)
    at_home = moved.field.query(Samples.at(samples.position, samples.direction @ ROTATION), Quantity.RADIANCE)
    torch.testing.assert_close(values.radiance, at_home.radiance)


@pytest.mark.parametrize("field", [GaussianBlob(1.5, 0.3, (0.2, 0, 0)), Slab(2.0, -0.5, 0.4, (1, 0, 1))])
def test_optical_depth_along_moved_rays_is_unchanged(field):
    """Integrating the moved density along the moved rays gives the closed form at home: density scales as 1 / length."""
    field = field.double()
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    home = Rays.make(-3 * directions + 0.3 * torch.randn(5, 3).double(), directions)
    home = home.within(home.near, torch.full((5,), 8.0, dtype=torch.float64))
    away = Rays.make(_moved(home.origins), directions @ ROTATION.T)
    t = torch.linspace(0, 8.0 * SCALE, 40_001, dtype=torch.float64)
    moved = Transformed(field, SIMILARITY)
    for i in range(5):
        line = away.origins[i] + t[:, None] * away.directions[i]
        density = moved.query(Samples.at(line), Quantity.DENSITY).density
        assert density is not None
        expected = field.optical_depth(home)[i]
        torch.testing.assert_close(torch.trapezoid(density, t), expected, atol=1e-3, rtol=0)


class _Spread(Encoding):
    """Shows an integrated encoding's covariance as features."""

    needs_covariance = True
    width = 6

    def forward(self, unit, covariance=None):
        assert covariance is not None
        return torch.cat([unit, covariance.diagonal(dim1=-2, dim2=-1)], dim=1)


class _SpreadConfig:
    def build(self):
        return _Spread()


def test_cones_keep_their_footprint(make_scene):
    """t0, t1 and the pixel radius go along, so an integrated encoding sees the same cone at home."""
    scene = make_scene(half=4.0)
    config = NeuralFieldConfig(_SpreadConfig(), layers=1, width=8, skip=-1, geometry_features=3)
    field = config.build(scene).double()
    n = 6
    directions = torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=1)
    home = Rays.make(torch.zeros(n, 3, dtype=torch.float64), directions, 0.2)
    away = Rays.make(_moved(home.origins), directions @ ROTATION.T, 0.2)
    t0 = torch.rand(n, dtype=torch.float64) + 0.2
    at_home = field.query(Samples.on(home, torch.arange(n), t0, t0 + 0.5), Quantity.DENSITY).density
    assert at_home is not None
    moved = Transformed(field, SIMILARITY)
    values = moved.query(Samples.on(away, torch.arange(n), SCALE * t0, SCALE * (t0 + 0.5)), Quantity.DENSITY)
    torch.testing.assert_close(values.density, at_home / SCALE)


def test_gaussians_go_along(make_scene):
    scene = make_scene(points=Points(torch.rand(9, 3), torch.rand(9, 3)))
    field = GaussianFieldConfig(sh_degree=2).build(scene).double()
    moved = Transformed(field, SIMILARITY)
    context = Context(scene.bounds)
    one = moved.primitives(Quantity.GAUSSIANS, context)
    other = field.transformed(SIMILARITY).primitives(Quantity.GAUSSIANS, context)
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name))
    assert moved.provides == Quantity.GAUSSIANS
    assert moved.primitive_count() == 9


def test_gradients_reach_positions_and_the_motion():
    field = GaussianBlob(1.5, 0.3).double()
    samples = _samples(4)

    def density(position, shift):
        similarity = torch.cat([torch.cat([SIMILARITY[:3, :3], shift[:, None]], 1), SIMILARITY[3:]])
        return Transformed(field, similarity).query(Samples.at(position), Quantity.DENSITY).density

    inputs = (samples.position.clone().requires_grad_(), SHIFT.clone().requires_grad_())
    assert torch.autograd.gradcheck(density, inputs)


@pytest.mark.parametrize("diagonal", [(1.0, 1, -1, 1), (1.0, 2, 1, 1), (0.0, 0, 0, 1)])
def test_other_matrices_are_refused(diagonal):
    with pytest.raises(InputError, match="similarity"):
        Transformed(Sphere(1.0, 1.0), torch.diag(torch.tensor(diagonal)))
