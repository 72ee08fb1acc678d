"""Expected frequencies over Gaussians: closed form against Monte Carlo, through the contraction too."""

import pytest
import torch
from torch.nn.functional import normalize

from invgraphics.config import fill
from invgraphics.core import Bounds, Rays, Samples
from invgraphics.errors import InputError
from invgraphics.fields.density_field import DensityFieldConfig
from invgraphics.fields.encoded import encode_samples
from invgraphics.fields.encodings.frequency import frequencies
from invgraphics.fields.encodings.integrated import IntegratedConfig, icosahedral_basis
from invgraphics.testing import toy_scene

F64 = torch.float64
BOUNDS = Bounds(torch.full((3,), -1.0, dtype=F64), torch.full((3,), 1.0, dtype=F64), "contracted")


def test_points_are_encoded_as_nerf_does() -> None:
    unit = torch.rand(7, 3, dtype=F64)
    expected = frequencies(2 * unit - 1, 5, include_input=False)
    torch.testing.assert_close(IntegratedConfig(octaves=5).build()(unit), expected)
    spread = torch.eye(3, dtype=F64).expand(7, 3, 3)
    torch.testing.assert_close(IntegratedConfig(octaves=5, integrated=False).build()(unit, spread), expected)


@pytest.mark.parametrize("basis", ["axes", "icosahedron"])
@pytest.mark.parametrize("distance", [0.5, 3.0])
def test_equals_the_mean_over_the_cone_s_gaussian_inside_and_outside_the_unit_ball(basis: str, distance: float) -> None:
    """Features of random points of the Gaussian, each contracted by itself, have the mean that the closed form predicts."""
    direction = normalize(torch.tensor([[0.6, -0.3, 0.7]], dtype=F64), dim=1)
    rays = Rays.make(torch.tensor([[0.1, 0.05, -0.02]], dtype=F64), direction, radius=0.01)
    t0, t1 = (torch.tensor([distance * factor], dtype=F64) for factor in (0.99, 1.01))
    samples = Samples.on(rays, torch.zeros(1, dtype=torch.int64), t0, t1)
    encoding = fill(IntegratedConfig, {"octaves": 8, "basis": basis}).build()
    found = encode_samples(encoding, BOUNDS, samples)[0]
    root = torch.linalg.cholesky(samples.covariance[0])
    points = samples.cone_mean + torch.randn(60_000, 3, dtype=F64) @ root.T
    features = encoding(BOUNDS.to_unit(points)).mean(dim=0)
    torch.testing.assert_close(found, features, atol=1e-2, rtol=0)
    # High octaves have been averaged away by then; those of the mean alone have not.
    still = encoding(BOUNDS.to_unit(samples.cone_mean))[0]
    assert float((still - features).abs().max()) > 0.1


def test_a_long_frustum_is_encoded_at_its_mean_and_not_at_its_interval_s_middle() -> None:
    """Points drawn in the frustum itself, whose mean is far beyond the middle: the lowest octaves tell the two apart."""
    rays = Rays.make(torch.tensor([[-0.9, 0.0, 0.0]], dtype=F64), torch.tensor([[1.0, 0.0, 0.0]], dtype=F64), radius=0.01)
    t0, t1 = torch.tensor([0.1], dtype=F64), torch.tensor([0.9], dtype=F64)
    samples = Samples.on(rays, torch.zeros(1, dtype=torch.int64), t0, t1)
    t = (t0**3 + (torch.arange(4000, dtype=F64) + 0.5) / 4000 * (t1**3 - t0**3)) ** (1 / 3)  # volume grows with t²
    encoding = IntegratedConfig(octaves=1).build()
    mean = encoding(BOUNDS.to_unit(rays.origins + t[:, None] * rays.directions)).mean(dim=0)
    torch.testing.assert_close(encode_samples(encoding, BOUNDS, samples)[0], mean, atol=5e-3, rtol=0)
    middle = encoding(BOUNDS.to_unit(samples.position), BOUNDS.unit_covariance(samples.position, samples.covariance))[0]
    assert float((middle - mean).abs().max()) > 0.1


def test_the_icosahedral_basis_is_a_tight_frame_of_21() -> None:
    basis = icosahedral_basis().double()
    assert basis.shape == (21, 3)
    torch.testing.assert_close(basis.T @ basis, 7 * torch.eye(3, dtype=F64), atol=1e-6, rtol=0)
    cosine = (basis @ basis.T).fill_diagonal_(0)
    # No two are opposite or equal; neighbours are 31.7 or 36 degrees apart.
    assert float(cosine.abs().max()) == pytest.approx(0.8506508, abs=1e-6)


def test_a_density_field_is_its_network_s_density_per_contracted_length() -> None:
    scene = toy_scene(views=2, size=4, space="contracted")
    field = DensityFieldConfig(layers=1, width=8, density_bias=0.5).build(scene)
    torch.nn.init.normal_(field.encoding.table)  # pyright: ignore[reportArgumentType, reportAttributeAccessIssue]
    point = scene.bounds.centre + torch.tensor([[0.2, 0.1, 0.0], [4.0, 3.0, 0.0]]) * scene.bounds.half
    raw = field.net(field.encoding(scene.bounds.to_unit(point)))[:, 0]
    expected = (raw + 0.5).exp() / float(scene.bounds.half.mean()) * torch.tensor([1.0, 1 / 25])
    torch.testing.assert_close(field.density_no_grad(Samples.at(point)), expected.detach())
    boxed = DensityFieldConfig().build(toy_scene(views=2, size=4))
    assert field.density_no_grad(Samples.at(point)).all()
    assert not boxed.density_no_grad(Samples.at(torch.tensor([[99.0, 0.0, 0.0]]))).any()


def test_refusals() -> None:
    with pytest.raises(InputError, match="octaves must be from 1 to 24"):
        fill(IntegratedConfig, {"octaves": 0})
    with pytest.raises(InputError, match="basis"):
        fill(IntegratedConfig, {"basis": "cube"})
    with pytest.raises(InputError, match="width must be at least 1"):
        fill(DensityFieldConfig, {"width": 0})


def test_features_are_means_of_sines_however_long_a_thin_frustum_is() -> None:
    """Contracted covariances of long, far intervals lose their digits, and with them their sign."""
    generator = torch.Generator().manual_seed(0)
    directions = normalize(torch.randn(500, 3, generator=generator), dim=1)
    rays = Rays.make(torch.randn(500, 3, generator=generator) * 0.7, directions, radius=0.0)
    bounds = Bounds(-torch.ones(3), torch.ones(3), "contracted")
    samples = Samples.on(rays, torch.arange(500), torch.full((500,), 20.0), torch.full((500,), 30.0))
    mean = samples.cone_mean
    encoding = IntegratedConfig(octaves=16, basis="icosahedron").build()
    features = encoding(bounds.to_unit(mean), bounds.unit_covariance(mean, samples.covariance))
    assert float(features.abs().max()) <= 1 + 1e-6
