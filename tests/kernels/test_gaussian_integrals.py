"""Compiled line integrals of Gaussians equal the reference in float64: pairs, light, and every gradient."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Bounds, Gaussians, Rays
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.gaussians import gaussian_composites, gaussian_integrals
from invgraphics.kernels.reference.gaussian_rays import gaussian_pairs, precompute
from invgraphics.testing import toy_cameras

pytestmark = pytest.mark.skipif("numba" not in kernels.dispatch.cpu_implementations(), reason="Numba does not work here")
SMALLEST = 1e-3


def blobs(n: int, seed: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=generator) * 0.4,
        quaternions=torch.randn(n, 4, generator=generator),
        scales=torch.rand(n, 3, generator=generator) * 0.2 + 0.02,
        opacities=torch.rand(n, generator=generator) * 0.95,
        sh=torch.randn(n, 9, 3, generator=generator) * 0.4,
    )


def rays_of(views: int, every: int) -> Rays:
    """Rays of several cameras, one after the other, within the box in which the Gaussians are."""
    rays = Rays.cat([camera.rays()[index::every] for index, camera in enumerate(toy_cameras(views, 12))])
    return Bounds(-1.3 * torch.ones(3), 1.3 * torch.ones(3)).clip(rays)


def test_pairs_are_those_of_the_reference() -> None:
    primitives = precompute(blobs(80, 0), "peak", SMALLEST)
    all_around = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    inside = Rays.make(torch.full((60, 3), 0.05), all_around)  # in the midst of them: no plane is tangent to all
    for rays in (rays_of(4, 3), rays_of(1, 1), rays_of(3, 200), inside, rays_of(2, 5)[:0]):
        found, expected = choose("gaussian_pairs", primitives.means)(primitives, rays), gaussian_pairs(primitives, rays)
        assert choose("gaussian_pairs", primitives.means) is not gaussian_pairs
        assert torch.equal(found[0], expected[0])
        assert torch.equal(found[1], expected[1])


@pytest.mark.parametrize("sigma", [1e-2, 1e-4, 3e-5])
def test_no_small_gaussian_is_lost(sigma: float) -> None:
    """Of Gaussians far smaller than their distance, each within 2.5 standard deviations of a ray through it: all are found."""
    (camera,) = toy_cameras(1, 96)
    rays, generator, n = camera.rays(), torch.Generator().manual_seed(0), 1500
    hit = torch.randperm(len(rays), generator=generator)[:n]
    aside = torch.linalg.cross(
        rays.directions[hit], torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    )
    aside = torch.nn.functional.normalize(aside, dim=1) * (2.5 * sigma * torch.rand(n, 1, generator=generator))
    means = rays.origins[hit] + 4 * rays.directions[hit] + aside
    small = replace(blobs(n, 0), means=means, scales=torch.full((n, 3), sigma))
    ray, gaussian = choose("gaussian_pairs", means)(precompute(small, "peak", 1e-7), rays)[:2]
    found = set(zip(ray.tolist(), gaussian.tolist(), strict=True))
    assert found >= set(zip(hit.tolist(), range(n), strict=True))


@pytest.mark.parametrize(
    ("opacity", "attenuated", "steps"),
    [("peak", True, 32), ("physical", True, 20), ("extinction", False, 49), ("peak", True, 2)],
)
def test_light_and_gradients_are_the_references(opacity: str, attenuated: bool, steps: int) -> None:
    rays, generator = rays_of(3, 7), torch.Generator().manual_seed(2)
    # Some begin or end within the cloud: their near and far planes cut Gaussians.
    half, third = (torch.arange(len(rays)) % k == 0 for k in (2, 3))
    rays = rays.within(torch.where(half, rays.near + 1.2, rays.near), torch.where(third, rays.far - 1.1, rays.far))
    wanted = torch.randn(len(rays), 4, generator=generator)

    def run(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        tensors = {name: value.to(dtype).requires_grad_() for name, value in vars(blobs(50, 3)).items()}
        moved = rays.to(dtype)
        moved = replace(
            moved, origins=moved.origins.clone().requires_grad_(), directions=moved.directions.clone().requires_grad_()
        )
        # Strong gradients make colours negative somewhere: what would lower those further must not pass.
        primitives = precompute(Gaussians(**tensors), opacity, SMALLEST, self_attenuation=attenuated)
        sums = gaussian_integrals(primitives, moved, steps)
        gradients = torch.autograd.grad((sums * wanted.to(dtype)).sum(), (*tensors.values(), moved.origins, moved.directions))
        return sums.detach(), *gradients

    for fast, exact in zip(run(torch.float32), run(torch.float64), strict=True):
        scale = float(exact.abs().max())
        assert scale > 0.1
        torch.testing.assert_close(fast.double(), exact, atol=3e-5 * scale, rtol=1e-3)


@pytest.mark.parametrize(
    ("opacity", "attenuated", "by"),
    [("peak", True, "ray"), ("physical", True, "centre"), ("extinction", False, "own"), ("splat", True, "ray")],
)
def test_composited_light_and_gradients_are_the_references(opacity: str, attenuated: bool, by: str) -> None:
    rays, generator = rays_of(3, 7), torch.Generator().manual_seed(2)
    # Some begin within the cloud: their near planes cut Gaussians.
    rays = rays.within(torch.where(torch.arange(len(rays)) % 2 == 0, rays.near + 1.2, rays.near), rays.far)
    wanted = torch.randn(len(rays), 4, generator=generator)
    axes = {"ray": None, "centre": torch.tensor([0.6, 0.0, 0.8]), "own": rays.directions}[by]

    def run(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        tensors = {name: value.to(dtype).requires_grad_() for name, value in vars(blobs(50, 3)).items()}
        moved = rays.to(dtype)
        moved = replace(
            moved, origins=moved.origins.clone().requires_grad_(), directions=moved.directions.clone().requires_grad_()
        )
        primitives = precompute(Gaussians(**tensors), opacity, SMALLEST, self_attenuation=attenuated)
        sums = gaussian_composites(primitives, moved, None if axes is None else axes.to(dtype))
        gradients = torch.autograd.grad((sums * wanted.to(dtype)).sum(), (*tensors.values(), moved.origins, moved.directions))
        return sums.detach(), *gradients

    for fast, exact in zip(run(torch.float32), run(torch.float64), strict=True):
        scale = float(exact.abs().max())
        assert scale > 0.1
        torch.testing.assert_close(fast.double(), exact, atol=3e-5 * scale, rtol=1e-3)


@pytest.mark.parametrize("kernel", [gaussian_integrals, gaussian_composites], ids=["integrals", "composites"])
def test_what_lies_behind_an_opaque_wall_is_left_out(kernel: Callable[..., torch.Tensor]) -> None:
    """Of rays through many dense layers, of which the reference sums all; and the fast one does not see the last."""
    count = 40
    layers = Gaussians(
        means=torch.stack([torch.zeros(count), torch.linspace(-1, 1, count), torch.zeros(count)], dim=1),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[0.5, 0.02, 0.5]]).repeat(count, 1),
        opacities=torch.full((count,), 0.9),
        sh=torch.randn(count, 1, 3, generator=torch.Generator().manual_seed(0)),
    )
    rays = Rays.make(torch.tensor([[0.1, -3, 0.0], [0.0, -3, 0.2]]), torch.tensor([[0.0, 1, 0]]).repeat(2, 1))
    last = {"means": layers.means.clone().requires_grad_()}
    given = (32,) if kernel is gaussian_integrals else (None,)
    fast = kernel(precompute(replace(layers, **last), "peak", SMALLEST), rays, *given)
    with kernels.using("reference"):
        exact = kernel(precompute(layers, "peak", SMALLEST), rays, *given)
    torch.testing.assert_close(fast.detach(), exact, atol=2e-5, rtol=1e-4)
    (gradient,) = torch.autograd.grad(fast.sum(), last["means"])
    assert bool(gradient[0].any())
    assert not bool(gradient[-1].any())


def test_distances_and_normals() -> None:
    rays, primitives = rays_of(2, 5), precompute(blobs(40, 4), "peak", SMALLEST)
    with torch.no_grad():
        fast = gaussian_integrals(primitives, rays, 32, 4)
        with kernels.using("reference"):
            exact = gaussian_integrals(primitives, rays, 32, 4)
    torch.testing.assert_close(fast, exact, atol=2e-5, rtol=1e-4)
    assert float(exact[:, 4].max()) > 1
    # A gradient of those is had, by the reference.
    with torch.no_grad():
        fast = gaussian_composites(primitives, rays, None, 4)
        with kernels.using("reference"):
            exact = gaussian_composites(primitives, rays, None, 4)
    torch.testing.assert_close(fast, exact, atol=2e-5, rtol=1e-4)
    moving = replace(primitives, means=primitives.means.clone().requires_grad_())
    gaussian_integrals(moving, rays, 8, 1)[:, 4].sum().backward()
    assert bool(moving.means.grad.any())


def test_nothing_in_view() -> None:
    primitives = precompute(blobs(5, 0), "peak", SMALLEST)
    away = Rays.make(torch.full((4, 3), 50.0), torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3))
    assert not gaussian_integrals(primitives, away, 8).any()


@pytest.mark.parametrize("name", ["reference", "numba"])
def test_a_ray_that_ends_before_it_begins_shows_nothing(name: str) -> None:
    """``far < near`` marks a ray that misses; with gradients of distances the reference computes it."""
    primitives = precompute(blobs(20, 0), "peak", SMALLEST)
    moving = replace(primitives, means=primitives.means.clone().requires_grad_())
    rays = Rays.make(torch.tensor([[0.1, -3, 0.0], [0.0, -3, 0.2]]), torch.tensor([[0.0, 1, 0]]).repeat(2, 1))
    rays = rays.within(torch.tensor([3.2, 2.0]), torch.tensor([2.8, 5.0]))
    with kernels.using(name):
        sums = gaussian_composites(moving, rays, None, 1)
    assert not bool(sums[0].any())
    assert bool(sums[1].any())


@pytest.mark.parametrize("width", [1e-4, 3e-4, 1e-3])
@pytest.mark.parametrize("offset", [0.0, 0.001, 0.006])
def test_thin_gaussians_hide_each_other_before_a_distant_one(width: float, offset: float) -> None:
    """A red sheet before a blue one, on rays that a faint Gaussian makes ten thousand times as long as their distance."""
    means = torch.tensor([[0.0, 2.0 + offset, 0.0], [0.0, 2.005 + offset, 0.0], [0.0, 100.0, 0.0]])
    gaussians = Gaussians(
        means=means,
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        scales=torch.tensor([[0.5, width, 0.5], [0.5, width, 0.5], [50.0, 50.0, 50.0]]),
        opacities=torch.tensor([0.95, 0.95, 0.3]),
        sh=torch.tensor([[[1.5, -1.5, -1.5]], [[-1.5, -1.5, 1.5]], [[0.0, 0.0, 0.0]]]),
    )
    rays = Rays.make(torch.tensor([[0.0, 0, 0], [0.1, 0, 0.1]]), torch.tensor([[0.0, 1, 0]]).repeat(2, 1))
    primitives = precompute(gaussians, "peak", SMALLEST)
    fast = gaussian_integrals(primitives, rays, 32)
    with kernels.using("reference"):
        exact = gaussian_integrals(primitives, rays, 32)
    assert float((exact[:, 1] / exact[:, 0]).max()) < 0.9
    torch.testing.assert_close(fast, exact, atol=2e-3, rtol=0)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("name", ["integrals", "composites"])
def test_a_camera_at_a_gaussians_centre_sees_its_mean_colour(name: str, moving: bool) -> None:
    """No direction leads there: the vector of length 0 is normalised to itself, as torch does it."""

    def run(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        gaussians = blobs(12, 4)
        tensors = {key: value.to(dtype).clone().requires_grad_() for key, value in vars(gaussians).items()}
        origins = gaussians.means[3].to(dtype).expand(6, 3).clone().requires_grad_(moving)
        directions = torch.nn.functional.normalize(
            torch.randn(6, 3, generator=torch.Generator().manual_seed(2)).to(dtype), dim=1
        )
        primitives, rays = precompute(Gaussians(**tensors), "peak", SMALLEST), Rays.make(origins, directions)
        kernel = gaussian_integrals if name == "integrals" else gaussian_composites
        light = kernel(primitives, rays, 16) if name == "integrals" else kernel(primitives, rays, None)
        return light.detach(), *torch.autograd.grad(light.square().sum(), [tensors["opacities"], tensors["sh"]])

    for found, expected in zip(run(torch.float32), run(torch.float64), strict=True):
        assert float(expected.abs().max()) > 0.1
        torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))
