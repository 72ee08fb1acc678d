"""Gaussians as a density: brute force, scipy, finite differences, and convergence to the exact line integrals."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from invgraphics.core import Context, Field, FieldValues, Gaussians, Quantity, Samples, Trace
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.fields.gaussian import GaussianField
from invgraphics.fields.gaussian_density import query_density
from invgraphics.kernels.extinction import SMALLEST_DEPTH, mean_inverse_scale, reach
from invgraphics.kernels.reference.gaussian_sums import overlapping_pairs
from invgraphics.renderers.gaussians.volume import GaussianExactConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import check_field, check_renderer, toy_scene

D, R, N = Quantity.DENSITY, Quantity.RADIANCE, Quantity.NORMAL


def blobs(n: int, seed: int = 0, smallest: float = 0.02) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=random(n, 3) * 1.4 - 0.7,
        quaternions=random(n, 4) - 0.5,
        scales=random(n, 3) * 0.15 + smallest,
        opacities=random(n) * 0.9 + 0.05,
        sh=random(n, 4, 3) - 0.5,
    )


def field_of(gaussians: Gaussians) -> GaussianField:
    """A field whose activated Gaussians are these."""
    field = GaussianField(
        {
            "means": gaussians.means,
            "quaternions": gaussians.quaternions,
            "log_scales": gaussians.scales.log(),
            "opacity_logits": gaussians.opacities.logit(),
            "sh_dc": gaussians.sh[:, :1],
            "sh_rest": gaussians.sh[:, 1:],
        }
    )
    return field


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_are_those_of_brute_force(seed: int) -> None:
    gaussians = blobs(60, seed, smallest=0.005)
    position = torch.rand(700, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 2.4 - 1.2
    whitening = quaternion_to_matrix(gaussians.quaternions).transpose(1, 2) / gaussians.scales[:, :, None]
    offset = position[:, None] - gaussians.means
    squared = torch.einsum("nij,mnj->mni", whitening, offset).square().sum(dim=-1)
    expected = (squared < reach(gaussians, "physical").square()).nonzero()
    assert len(expected) > 300
    assert torch.equal(torch.stack(overlapping_pairs(gaussians, position), dim=1), expected)
    alone = overlapping_pairs(gaussians, position[5:6])
    assert torch.equal(alone[1], expected[expected[:, 0] == 5, 1])


def test_density_is_scipys() -> None:
    gaussians = blobs(5)
    # Close to the first centre, where no other truncated tail can matter for what is compared.
    position = gaussians.means[:1] + torch.tensor([[0.0, 0.0, 0.0], [0.01, -0.02, 0.005]], dtype=torch.float64)
    expected = np.zeros(2)
    for i in range(5):
        axes, scales = quaternion_to_matrix(gaussians.quaternions[i]).numpy(), gaussians.scales[i].numpy()
        law = multivariate_normal(gaussians.means[i].numpy(), axes @ np.diag(scales**2) @ axes.T)
        # The optical depth averaged over directions is that of the peak reading.
        depth = -math.log1p(-float(gaussians.opacities[i])) * float(mean_inverse_scale(gaussians.scales[i : i + 1]))
        expected += depth / math.sqrt(2 * math.pi) * law.pdf(position.numpy()) / law.pdf(law.mean)
    found = query_density(gaussians, Samples.at(position), D).density
    np.testing.assert_allclose(found.numpy(), expected, rtol=2e-3)


def test_gradients_are_finite_differences() -> None:
    few = blobs(4)
    position = few.means[[0, 1, 2, 3, 0]] + 0.03
    direction = torch.nn.functional.normalize(torch.ones(5, 3, dtype=torch.float64), dim=1)

    def values(means, quaternions, scales, opacities, sh, at):
        found = query_density(Gaussians(means, quaternions, scales, opacities, sh), Samples.at(at, direction), D | R)
        return found.density, found.radiance

    tensors = (few.means, few.quaternions, few.scales, few.opacities, few.sh.clamp(-0.2, 0.4), position)
    assert torch.autograd.gradcheck(values, tuple(tensor.clone().requires_grad_() for tensor in tensors), atol=1e-5)


def test_normal_is_minus_the_densitys_gradient() -> None:
    gaussians, position = blobs(20), (torch.rand(50, 3, dtype=torch.float64) - 0.5).requires_grad_()
    density = query_density(gaussians, Samples.at(position), D).density
    (gradient,) = torch.autograd.grad(density.sum(), position)
    normal = query_density(gaussians, Samples.at(position), N).normal
    inside = density > 0
    assert int(inside.sum()) > 10
    torch.testing.assert_close(normal[inside], -torch.nn.functional.normalize(gradient, dim=1)[inside], atol=1e-9, rtol=0)
    assert not normal[~inside].any()


class Untruncated(Field):
    """Gaussians of which next to nothing is left out, so that only the steps of a quadrature matter."""

    provides = Quantity.GAUSSIANS | D | R

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians = gaussians

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        return query_density(self.gaussians, samples, want, smallest=1e-9)

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        return self.gaussians


def rms_errors(field: Field, counts: tuple[int, ...], smallest: float) -> list[float]:
    """Of quadrature with these steps per ray, against the exact line integrals."""
    scene = toy_scene(views=2, size=16)
    camera, white = scene.test[0].camera.to(torch.float64), scene.background.double()
    ctx, errors = Context(scene.bounds.to(torch.float64)), []
    with torch.no_grad():
        config = GaussianExactConfig(opacity="physical", steps=512, smallest=smallest)
        exact, _ = config.build(scene).render_image(field, camera, ctx)
        for count in counts:
            picture, trace = VolumetricConfig(StratifiedConfig(count)).build(scene).render_image(field, camera, ctx)
            errors.append(float((picture.over(white) - exact.over(white)).square().mean().sqrt()))
    assert trace.empty_samples is not None
    return errors


def test_quadrature_converges_to_the_exact_integral() -> None:
    errors = rms_errors(Untruncated(blobs(12)), (8, 16, 32), smallest=1e-9)
    # In the first order of the step at least: faster where the steps resolve the thinnest Gaussian.
    assert all(finer < 0.5 * coarser for coarser, finer in pairwise(errors))
    assert errors[-1] < 5e-5


def test_512_steps_show_what_the_exact_integral_shows() -> None:
    field = field_of(blobs(40))
    field.active_degree = 1
    (error,) = rms_errors(field, (512,), SMALLEST_DEPTH)
    assert -20 * math.log10(error) > 45


def test_empty_samples_are_counted() -> None:
    scene, field = toy_scene(views=2, size=8), field_of(Gaussians(**{n: v.float() for n, v in vars(blobs(10)).items()}))
    _, trace = (
        VolumetricConfig(StratifiedConfig(64)).build(scene).render_image(field, scene.test[0].camera, Context(scene.bounds))
    )
    density = field.density_no_grad(trace.samples)
    assert trace.empty_samples == pytest.approx(float((density == 0).float().mean()))
    assert 0.5 < trace.empty_samples < 1
    assert Trace().empty_samples is None


def test_contract_and_samplers() -> None:
    scene = toy_scene(views=2, size=8)
    field = field_of(Gaussians(**{name: value.float() for name, value in vars(blobs(30)).items()}))
    check_field(field, scene)
    for sampler in (StratifiedConfig(48), OccupancyConfig(resolution=16, steps_per_diagonal=64)):
        check_renderer(VolumetricConfig(sampler).build(scene), field, scene)


def test_nothing_anywhere() -> None:
    far = blobs(3)
    far.means.add_(100.0)
    values = query_density(far, Samples.at(torch.zeros(2, 3, dtype=torch.float64)), D | R | N)
    assert not values.density.any()
    assert not values.radiance.any()
    assert not values.normal.any()
