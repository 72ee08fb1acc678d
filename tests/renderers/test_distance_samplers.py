"""Samplers that look at a signed distance: VolSDF's bound against true errors, NeuS's up-sampling against true hits."""

import pytest
import torch
from torch import Tensor

from invgraphics.core import Bounds, Context, Quantity, Rays
from invgraphics.errors import NotComposableError
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.distance_density import LaplaceDensity, laplace_density
from invgraphics.renderers.error_bounded import ErrorBoundedConfig, clear_distance, error_bounds
from invgraphics.renderers.up_sampling import UpSamplingConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import toy_scene

BALL = Sphere(1.0, 0.5).double()
BOX = Bounds(-torch.ones(3).double(), torch.ones(3).double(), near=0.0)


def rays_at(offsets: Tensor) -> Rays:
    """Rays along +z from z = -1 to 1, at these distances from the ball's centre."""
    origins = torch.stack([offsets, torch.zeros_like(offsets), torch.full_like(offsets, -1.0)], dim=1)
    rays = Rays.make(origins, origins.new_tensor([0.0, 0.0, 1.0]).expand(len(offsets), 3))
    return rays.within(torch.zeros_like(offsets), torch.full_like(offsets, 2.0))


def sdf_along(rays: Rays, t: Tensor) -> Tensor:
    position = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    return position.norm(dim=-1) - 0.5


def opacity(rays: Rays, beta: float, t: Tensor) -> Tensor:
    """Opacity up to distances t, by the trapezoidal rule on a fine grid."""
    fine = torch.linspace(0, 2, 20001, dtype=torch.float64).expand(len(rays), -1)
    density = laplace_density(sdf_along(rays, fine), torch.tensor(beta).double())
    depth = torch.nn.functional.pad(((density[:, 1:] + density[:, :-1]) / 2 * 1e-4).cumsum(dim=1), (1, 0))
    return 1 - torch.exp(-depth.gather(1, (t / 1e-4).round().long()))


def test_clear_distance_is_a_lower_bound() -> None:
    rays = rays_at(torch.linspace(0, 0.95, 12).double())
    edges = torch.rand(12, 30, dtype=torch.float64).mul(2).sort(dim=1).values
    clear = clear_distance(sdf_along(rays, edges), edges.diff(dim=1))
    share = torch.linspace(0, 1, 101, dtype=torch.float64)
    within = torch.lerp(edges[:, :-1, None], edges[:, 1:, None], share)
    nearest = sdf_along(rays, within.flatten(1)).abs().view(12, 29, 101).amin(dim=2)
    assert bool((clear <= nearest + 1e-9).all())
    # Not trivially so: far from the surface it is most of the distance.
    assert float((clear / nearest)[nearest > 0.2].mean()) > 0.8


def test_no_distance_is_clear_where_a_surface_is_crossed() -> None:
    """A network's slope may exceed 1: at 3 the balls around both ends overlap although the surface lies between them."""
    edges = torch.linspace(0, 1, 9)[None]
    sdf = 3 * (0.55 - edges)
    clear = clear_distance(sdf, edges.diff(dim=1))
    crossing = (edges[:, :-1] < 0.55) & (edges[:, 1:] > 0.55)
    assert int(crossing.sum()) == 1 and float(clear[crossing]) == 0
    assert bool((clear[~crossing] > 0).all())


@pytest.mark.parametrize("beta", [0.02, 0.1, 0.3])
def test_error_bounds_hold(beta: float) -> None:
    """Theorem 1: the opacity of a left Riemann sum errs by no more than the bound, at every edge."""
    rays = rays_at(torch.linspace(0, 0.7, 8).double())
    edges = (torch.rand(8, 63, dtype=torch.float64).mul(2)).sort(dim=1).values.mul(1e4).round().div(1e4)
    edges = torch.cat([edges.new_zeros(8, 1), edges], dim=1)
    delta, sdf = edges.diff(dim=1), sdf_along(rays, edges)
    width = torch.full((8, 1), beta, dtype=torch.float64)
    bounds = error_bounds(delta, sdf, clear_distance(sdf, delta), width)
    sums = (laplace_density(sdf[:, :-1], width) * delta).cumsum(dim=1)
    error = (1 - torch.exp(-sums) - opacity(rays, beta, edges[:, 1:])).abs()
    assert bool((error <= bounds + 1e-5).all())
    assert float(error.max()) > 1e-3


@pytest.mark.parametrize("beta", [0.005, 0.05])
def test_the_final_samples_find_the_surface(beta: float) -> None:
    """Between two neighbouring edges around the hit the opacity rises little, and the edges gather there."""
    rays = rays_at(torch.tensor([0.0, 0.2, 0.4]).double())
    sampler = ErrorBoundedConfig(coarse=64, fine=48, extra=8).build(toy_scene(views=2, size=4))
    field = LaplaceDensity(BALL, torch.tensor(beta).double())
    samples, (level,) = sampler.sample(rays, field, Context(BOX))
    assert samples.t0.view(3, -1).shape[1] == 48 + 8 + 1
    hit = 1 - (0.25 - rays.origins[:, 0].square()).sqrt()
    near = (samples.mid.view(3, -1) - hit[:, None]).abs() < 4 * beta
    assert int(near.sum(dim=1).min()) > 20
    assert level.weights is not None
    assert float(level.weights.view(3, -1).sum(dim=1).min()) > 0.99


def test_up_sampling_gathers_at_the_first_surface() -> None:
    rays = rays_at(torch.tensor([0.0, 0.2, 0.4, 0.9]).double())
    sampler = UpSamplingConfig(coarse=32, fine=32, rounds=4).build(toy_scene(views=2, size=4))
    samples, levels = sampler.sample(rays, BALL, Context(BOX))
    edges = samples.t0.view(4, 64)
    assert len(levels) == 4
    front = 1 - (0.25 - rays.origins[:3, 0].square()).sqrt()
    share = ((edges[:3] - front[:, None]).abs() < 0.1).double().mean(dim=1)
    behind = ((edges[:3] - (2 - front[:, None])).abs() < 0.1).double().mean(dim=1)
    assert float(share.min()) > 0.4
    assert float(behind.max()) < 0.2
    # A ray that misses keeps an even spread: no gap of more than a few strata.
    assert float(samples.delta.view(4, 64)[3].max()) < 0.2


def test_they_ask_for_a_distance_and_say_so() -> None:
    scene, ball = toy_scene(views=2, size=8), Sphere(2.0, 0.5)
    renderer, ctx = VolumetricConfig(UpSamplingConfig(64, 192, 4)).build(scene), Context(scene.bounds)
    assert renderer.requires == Quantity.DENSITY | Quantity.RADIANCE
    assert renderer.required == renderer.requires | Quantity.SDF
    rays = scene.train[0].camera.rays()
    rendering, _ = renderer.render_rays(ball, rays, ctx)
    expected = 1 - torch.exp(-ball.optical_depth(scene.bounds.clip(rays)))
    torch.testing.assert_close(rendering.alpha, expected, rtol=0, atol=0.02)
    bounded = VolumetricConfig(ErrorBoundedConfig(16, 8, 4)).build(scene)
    with pytest.raises(NotComposableError, match="derived from a signed distance, not that of Sphere"):
        bounded.render_rays(ball, rays, ctx)
