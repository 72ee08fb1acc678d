"""Compiled sums of Gaussian densities equal the reference in float64, with every gradient; and a brute-force sum."""

import math

import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Gaussians, harmonics
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.extinction import mean_inverse_scale
from invgraphics.kernels.gaussians import gaussian_density
from invgraphics.kernels.reference.gaussian_sums import gaussian_density as reference

pytestmark = pytest.mark.skipif("numba" not in kernels.dispatch.cpu_implementations(), reason="Numba does not work here")
SMALLEST = 1e-3


def blobs(n: int, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(n, 3, generator=generator) * 0.4,
        "quaternions": torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator) * 0.2 + 0.02,
        "opacities": torch.rand(n, generator=generator) * 0.95,
        "sh": torch.randn(n, 9, 3, generator=generator) * 0.4,
    }


def points(m: int, eyes: int, seed: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    """Points within and outside, and eyes of which each sees several that follow each other."""
    generator = torch.Generator().manual_seed(seed)
    position = torch.randn(m, 3, generator=generator) * 0.6
    eye = torch.nn.functional.normalize(torch.randn(eyes, 3, generator=generator), dim=1) * 3
    return position, eye.repeat_interleave(-(-m // eyes), dim=0)[:m]


@pytest.mark.parametrize("coloured", [True, False])
def test_sums_and_gradients_are_the_references(coloured: bool) -> None:
    position, eye = points(300, 7)
    wanted = torch.randn(300, 4 if coloured else 1, generator=torch.Generator().manual_seed(2))

    def run(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        tensors = {name: value.to(dtype).requires_grad_() for name, value in blobs(60, 3).items()}
        assert (choose("gaussian_density", tensors["means"]) is reference) == (dtype == torch.float64)
        sums = gaussian_density(Gaussians(**tensors), position.to(dtype), eye.to(dtype) if coloured else None, SMALLEST)
        gradients = torch.autograd.grad((sums * wanted.to(dtype)).sum(), list(tensors.values()), allow_unused=not coloured)
        return sums.detach(), *(gradient for gradient in gradients if gradient is not None)

    for fast, exact in zip(run(torch.float32), run(torch.float64), strict=False):
        scale = float(exact.abs().max())
        assert scale > 0.1
        torch.testing.assert_close(fast.double(), exact, atol=3e-5 * scale, rtol=1e-3)


def test_sums_are_those_of_brute_force() -> None:
    gaussians, (position, eye) = Gaussians(**blobs(40, 1)), points(80, 2)
    axes = quaternion_to_matrix(gaussians.quaternions)
    offset = position[:, None] - gaussians.means
    squared = (torch.einsum("nji,mnj->mni", axes, offset) / gaussians.scales).square().sum(dim=-1)
    peak = -torch.log1p(-gaussians.opacities) * mean_inverse_scale(gaussians.scales) / math.sqrt(2 * math.pi)
    density = peak * torch.exp(-0.5 * squared)
    towards = torch.nn.functional.normalize(gaussians.means - eye[:, None], dim=-1)
    rgb = harmonics.colour(gaussians.sh.expand(80, -1, -1, -1).reshape(-1, 9, 3), towards.reshape(-1, 3)).view(80, 40, 3)
    expected = torch.cat([density.sum(dim=1, keepdim=True), (density[..., None] * rgb).sum(dim=1)], dim=1)
    found = gaussian_density(gaussians, position, eye, 1e-9)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_points_that_nothing_reaches_have_zeros() -> None:
    gaussians = Gaussians(**blobs(5, 0))
    far = torch.full((3, 3), 50.0)
    assert not gaussian_density(gaussians, far, far + 1, SMALLEST).any()
    assert gaussian_density(gaussians, far[:0], far[:0], SMALLEST).shape == (0, 4)
    mixed = torch.cat([far, gaussians.means[:1]])
    sums = gaussian_density(gaussians, mixed, mixed + 1, SMALLEST)
    assert not sums[:3].any()
    assert float(sums[3, 0]) > 0


@pytest.mark.parametrize("implementation", kernels.dispatch.cpu_implementations())
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_position_that_is_not_finite_leaves_the_others_their_densities(implementation: str, value: float) -> None:
    gaussians, (position, eye) = Gaussians(**blobs(40, 1)), points(30, 2)
    with kernels.using(implementation):
        expected = gaussian_density(gaussians, position, eye, SMALLEST)
        position[[3, 17], [0, 2]] = value
        found = gaussian_density(gaussians, position, eye, SMALLEST)
        assert not gaussian_density(gaussians, torch.full((2, 3), value), eye[:2], SMALLEST).any()
    others = torch.tensor([i for i in range(30) if i not in (3, 17)])
    assert float(expected[others].abs().max()) > 0.1
    torch.testing.assert_close(found[others], expected[others])
    assert not found[[3, 17]].any()


def test_an_eye_at_a_centre_gives_finite_colours() -> None:
    gaussians, (position, _) = Gaussians(**blobs(40, 1)), points(30, 2)
    eye = gaussians.means[5].expand(30, 3)
    position[:9] = gaussians.means[5] + 0.03 * position[:9]
    found = gaussian_density(gaussians, position, eye, SMALLEST)
    assert float(found[:9].amin()) > 0
    with kernels.using("reference"):
        torch.testing.assert_close(found, gaussian_density(gaussians, position, eye, SMALLEST), atol=1e-5, rtol=1e-4)
