"""Gaussians along rays: closed forms, scipy's quadrature, Monte Carlo, finite differences, order, conventions, conformance."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import cumulative_trapezoid, quad
from scipy.special import elliprg
from scipy.stats import multivariate_normal, norm

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Gaussians, Quantity, Rays, Samples
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.kernels.extinction import mean_inverse_scale
from invgraphics.kernels.reference.gaussian_rays import intersect, precompute
from invgraphics.renderers.gaussians.volume import GaussianExactConfig, GaussianSortedConfig
from invgraphics.testing import check_renderer, toy_cameras, toy_scene

F64 = torch.float64
BOUNDS = Bounds(torch.full((3,), -1.5, dtype=F64), torch.full((3,), 1.5, dtype=F64), near=1e-3)
CTX = Context(BOUNDS, geometry=True)
EXACT = GaussianExactConfig(steps=400, smallest=1e-12)
SORTED = GaussianSortedConfig(smallest=1e-12)


class Fixed(Field):
    """Given Gaussians."""

    provides = Quantity.GAUSSIANS

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians = gaussians

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotImplementedError

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        return self.gaussians


def some(n: int, seed: int = 0, **given: torch.Tensor) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    values = {
        "means": torch.randn(n, 3, dtype=F64, generator=generator) * 0.3,
        "quaternions": torch.randn(n, 4, dtype=F64, generator=generator),
        "scales": torch.rand(n, 3, dtype=F64, generator=generator) * 0.3 + 0.05,
        "opacities": torch.rand(n, dtype=F64, generator=generator) * 0.85 + 0.1,
        "sh": torch.randn(n, 4, 3, dtype=F64, generator=generator) * 0.3,
    }
    return Gaussians(**(values | given))


def permuted(gaussians: Gaussians, order: torch.Tensor) -> Gaussians:
    return Gaussians(**{name: getattr(gaussians, name)[order] for name in Gaussians.__dataclass_fields__})


def some_rays(n: int, seed: int = 1) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, dtype=F64, generator=generator), dim=1) * 3
    targets = torch.randn(n, 3, dtype=F64, generator=generator) * 0.2
    return Rays.make(origins, torch.nn.functional.normalize(targets - origins, dim=1))


def show(config: Any, gaussians: Gaussians, rays: Rays, ctx: Context = CTX) -> Any:
    return config.build(None).render_rays(Fixed(gaussians), rays, ctx)[0]


def line_density(gaussians: Gaussians, i: int, rays: Rays, r: int) -> Callable[[Any], Any]:
    """A Gaussian of peak 1 along a ray, by scipy from the 3D covariance."""
    axes = quaternion_to_matrix(gaussians.quaternions)[i].numpy()
    covariance = axes @ np.diag(gaussians.scales[i].numpy() ** 2) @ axes.T
    normal = multivariate_normal(gaussians.means[i].numpy(), covariance)
    origin, direction = rays.origins[r].numpy(), rays.directions[r].numpy()
    peak = normal.pdf(gaussians.means[i].numpy())
    return lambda t: normal.pdf(origin + np.asarray(t)[..., None] * direction) / peak


def test_each_gaussian_on_a_ray_is_measured_as_scipy_integrates_it() -> None:
    gaussians, rays = some(4), some_rays(3)
    found = intersect(precompute(gaussians, "physical", 1e-12), rays)
    assert len(found) == 12
    strength = -np.log1p(-gaussians.opacities.numpy()) * mean_inverse_scale(gaussians.scales).numpy() / math.sqrt(2 * math.pi)
    for r, i, t, depth in zip(
        *(getattr(found, name).tolist() for name in ("ray", "gaussian", "t", "optical_depth")), strict=True
    ):
        density = line_density(gaussians, i, rays, r)
        whole, _ = quad(lambda t, density=density: float(density(t)), 0, 7, points=[t], limit=200)
        assert depth == pytest.approx(strength[i] * whole, rel=1e-6)
        near = t + np.linspace(-0.5, 0.5, 2001)
        assert abs(near[np.argmax(density(near))] - t) < 1e-3


def test_peak_reading_gives_the_opacity_from_every_side() -> None:
    one = some(1, means=torch.zeros(1, 3, dtype=F64), opacities=torch.tensor([0.7], dtype=F64))
    rays = some_rays(20)
    through = replace(rays, directions=-torch.nn.functional.normalize(rays.origins, dim=1))
    for config in (EXACT, SORTED, replace(SORTED, opacity="splat")):
        torch.testing.assert_close(show(config, one, through).alpha, torch.full((20,), 0.7, dtype=F64), atol=1e-9, rtol=0)


def test_physical_reading_is_one_density_in_space() -> None:
    """Through the centre, optical depth is proportional to the chord; for a sphere the two readings are the same."""
    scales = torch.tensor([[0.4, 0.1, 0.2]], dtype=F64)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=F64)
    one = some(1, means=torch.zeros(1, 3, dtype=F64), scales=scales, quaternions=upright)
    directions = torch.eye(3, dtype=F64)
    rays = Rays.make(-3 * directions, directions)
    depth = -torch.log1p(-show(replace(EXACT, opacity="physical"), one, rays).alpha)
    torch.testing.assert_close(depth / depth.sum(), (scales / scales.sum())[0])
    sphere = some(1, scales=torch.full((1, 3), 0.2, dtype=F64))
    rays = some_rays(10)
    peak, physical = (show(replace(EXACT, opacity=reading), sphere, rays) for reading in ("peak", "physical"))
    torch.testing.assert_close(peak.alpha, physical.alpha)


def test_extinction_reading_is_the_papers_projection() -> None:
    """Celarek et al.: a' = θ 2π √(λ1 λ2) / I2(Σ'), with eigenvalues and projected covariances by numpy."""
    gaussians, rays = some(3), some_rays(4)
    found = intersect(precompute(gaussians, "extinction", 1e-12), rays)
    theta = -np.log1p(-gaussians.opacities.numpy())
    for r, i, depth in zip(*(getattr(found, name).tolist() for name in ("ray", "gaussian", "optical_depth")), strict=True):
        axes = quaternion_to_matrix(gaussians.quaternions)[i].numpy()
        covariance = axes @ np.diag(gaussians.scales[i].numpy() ** 2) @ axes.T
        _, _, frame = np.linalg.svd(rays.directions[r].numpy()[None])
        across = frame[1:]
        projected = across @ covariance @ across.T
        offset = across @ (rays.origins[r] - gaussians.means[i]).numpy()
        largest = np.sort(np.linalg.eigvalsh(covariance))[1:]
        whole = theta[i] * 2 * math.pi * math.sqrt(largest.prod()) / (2 * math.pi * math.sqrt(np.linalg.det(projected)))
        assert depth == pytest.approx(whole * math.exp(-0.5 * offset @ np.linalg.solve(projected, offset)), rel=1e-9)


def test_extinction_reading_has_the_same_mass_from_every_side() -> None:
    """Optical depths of the renderer, integrated over a plane across any direction, are those of the broad side."""
    scales = torch.tensor([[0.25, 0.1, 0.15]], dtype=F64)
    one = some(1, means=torch.zeros(1, 3, dtype=F64), scales=scales, opacities=torch.tensor([0.6], dtype=F64))
    u = torch.linspace(-1.4, 1.4, 57, dtype=F64)
    x, y = (grid.reshape(-1, 1) for grid in torch.meshgrid(u, u, indexing="ij"))
    for seed in range(3):
        frame = torch.linalg.qr(torch.randn(3, 3, dtype=F64, generator=torch.Generator().manual_seed(seed)))[0]
        rays = Rays.make(x * frame[0] + y * frame[1] - 3 * frame[2], frame[2].expand(len(x), 3))
        mass = -torch.log1p(-show(replace(EXACT, opacity="extinction", steps=8), one, rays).alpha).sum() * (u[1] - u[0]) ** 2
        assert float(mass) == pytest.approx(-math.log(0.4) * 2 * math.pi * 0.25 * 0.15, rel=1e-6)


@pytest.mark.parametrize("config", [EXACT, SORTED], ids=str)
def test_without_self_attenuation_alphas_are_optical_depths(config: Any) -> None:
    """Closed forms for one Gaussian, two far apart, two in one place, and one that is too dense for an alpha."""
    config = replace(config, self_attenuation=False)
    white, black = 0.5 / math.sqrt(1 / (4 * math.pi)), -0.5 / math.sqrt(1 / (4 * math.pi))
    rays = Rays.make(torch.tensor([[0.0, -3, 0]], dtype=F64), torch.tensor([[0.0, 1, 0]], dtype=F64))
    a, b = 0.3, 0.5  # optical depths; the first Gaussian shines

    def picture(*given: tuple[float, float]) -> Any:
        n = len(given)
        means = torch.tensor([[0.0, y, 0.0] for y, _ in given], dtype=F64)
        opacities = torch.tensor([-math.expm1(-depth) for _, depth in given], dtype=F64)
        sh = torch.tensor([white] + [black] * (n - 1), dtype=F64)[:, None, None].expand(n, 1, 3)
        scales = torch.full((n, 3), 0.08, dtype=F64)
        return show(
            config, Gaussians(means, torch.tensor([[1.0, 0, 0, 0]], dtype=F64).repeat(n, 1), scales, opacities, sh), rays
        )

    assert float(picture((0.0, a)).alpha) == pytest.approx(a, abs=1e-9)
    assert float(picture((0.0, 2.0)).alpha) == pytest.approx(0.99, abs=1e-9)
    apart = picture((1.0, a), (-1.0, b))
    assert float(apart.rgb[0, 0]) == pytest.approx((1 - b) * a, abs=1e-6)
    assert float(apart.alpha) == pytest.approx(b + (1 - b) * a, abs=1e-9)
    if isinstance(config, GaussianExactConfig):
        same = picture((0.0, a), (0.0, a))
        assert float(same.alpha) == pytest.approx(1 - (1 - a) ** 2, abs=1e-9)
        assert float(same.rgb[0, 0]) == pytest.approx((1 - (1 - a) ** 2) / 2, abs=1e-6)


def test_splat_alphas_cannot_lose_an_attenuation_that_they_lack() -> None:
    with pytest.raises(ValueError, match="splat"):
        GaussianSortedConfig(opacity="splat", self_attenuation=False)


def test_mean_inverse_scale_is_that_of_an_ellipsoids_surface() -> None:
    """Against Carlson's integral, for spheres, needles and discs."""
    scales = torch.tensor([[1.0, 1, 1], [1, 0.1, 0.1], [1, 1, 0.01], [0.5, 0.2, 0.05], [1, 1e-3, 1e-5]], dtype=F64)
    expected = [elliprg(*(1 / row**2)) for row in scales.numpy()]
    np.testing.assert_allclose(mean_inverse_scale(scales).numpy(), expected, rtol=0.011)
    assert float(mean_inverse_scale(scales[:1])) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("opacity", ["peak", "physical"])
def test_overlapping_gaussians_are_the_volume_rendering_equation(opacity: str) -> None:
    """Against brute force: 40,000 small steps of densities from scipy."""
    gaussians, rays = some(5, sh=torch.rand(5, 1, 3, dtype=F64)), some_rays(4)
    found = intersect(precompute(gaussians, opacity, 1e-12), rays)
    picture = show(replace(EXACT, opacity=opacity), gaussians, rays)
    rgb = (gaussians.sh[:, 0] * math.sqrt(1 / (4 * math.pi)) + 0.5).numpy()
    t = np.linspace(0, 6, 40_001)
    for r in range(4):
        densities = np.zeros((5, len(t)))
        for i, depth in zip(found.gaussian[found.ray == r].tolist(), found.optical_depth[found.ray == r].tolist(), strict=True):
            profile = line_density(gaussians, i, rays, r)(t)
            densities[i] = profile * depth / np.trapezoid(profile, t)
        before = cumulative_trapezoid(densities.sum(0), t, initial=0)
        light = np.exp(-before) * densities
        colour = (np.trapezoid(light, t, axis=1)[:, None] * rgb).sum(0)
        np.testing.assert_allclose(picture.rgb[r].numpy(), colour, atol=2e-5)
        assert float(picture.alpha[r]) == pytest.approx(1 - math.exp(-before[-1]), abs=1e-7)
        if float(picture.alpha[r]) >= 0.5:
            assert float(picture.depth[r]) == pytest.approx(
                np.trapezoid(light.sum(0) * t, t) / float(picture.alpha[r]), abs=1e-4
            )


def test_overlapping_gaussians_agree_with_free_flights() -> None:
    """Monte Carlo: photons stop at the first of each Gaussian's own exponential flights; who stops one gives the colour."""
    gaussians, rays, count = some(3, scales=torch.full((3, 3), 0.4, dtype=F64)), some_rays(1), 400_000
    found = intersect(precompute(gaussians, "peak", 1e-12), rays)
    t, sigma, depth = (getattr(found, name).numpy() for name in ("t", "sigma", "optical_depth"))
    flights = np.random.default_rng(0).exponential(size=(count, len(t)))
    stops = np.where(flights < depth, t + sigma * norm.ppf(np.minimum(flights / depth, 1)), np.inf)
    white, black = 0.5 / math.sqrt(1 / (4 * math.pi)), -0.5 / math.sqrt(1 / (4 * math.pi))
    assert len(t) >= 2 and (depth > 0.1).sum() >= 2
    for k in range(len(t)):
        sh = torch.full((3, 1, 3), black, dtype=F64)
        sh[int(found.gaussian[k])] = white
        share = float(show(EXACT, replace(gaussians, sh=sh), rays).rgb[0, 0])
        stopped = ((stops.argmin(1) == k) & np.isfinite(stops.min(1))).mean()
        assert share == pytest.approx(stopped, abs=4 * math.sqrt(0.25 / count))


def test_alone_a_gaussian_looks_the_same_in_both() -> None:
    """Up to the depth, which for a sorted Gaussian is where its response is largest."""
    one, rays = some(1, opacities=torch.tensor([0.9], dtype=F64)), some_rays(30)
    for opacity in ("peak", "physical"):
        exact, ordered = (show(replace(config, opacity=opacity), one, rays) for config in (EXACT, SORTED))
        torch.testing.assert_close(exact.rgb, ordered.rgb, atol=1e-12, rtol=0)
        torch.testing.assert_close(exact.alpha, ordered.alpha, atol=1e-12, rtol=0)
        torch.testing.assert_close(exact.normal, ordered.normal)


def test_far_apart_gaussians_look_the_same_in_both() -> None:
    means = torch.tensor([[0.0, -1, 0], [0, 0, 0], [0, 1, 0]], dtype=F64)
    apart = some(3, means=means, scales=torch.full((3, 3), 0.1, dtype=F64))
    rays = Rays.make(torch.tensor([[0.05, -3, 0.02]], dtype=F64), torch.tensor([[0.0, 1, 0]], dtype=F64))
    torch.testing.assert_close(show(EXACT, apart, rays).rgb, show(SORTED, apart, rays).rgb, atol=1e-5, rtol=0)


def test_order_and_splitting_mean_nothing_to_the_integral() -> None:
    """Permuted primitives, and one Gaussian as two halves of its optical depth in one place, give the same picture."""
    gaussians, rays = some(6), some_rays(20)
    picture = show(EXACT, gaussians, rays)
    shuffled = show(EXACT, permuted(gaussians, torch.randperm(6, generator=torch.Generator().manual_seed(3))), rays)
    torch.testing.assert_close(picture.rgb, shuffled.rgb, atol=1e-10, rtol=0)
    order = torch.tensor([0, 0, 1, 2, 3, 4, 5])
    halves = permuted(gaussians, order)
    halves.opacities[:2] = 1 - (1 - gaussians.opacities[0]).sqrt()
    torch.testing.assert_close(show(EXACT, halves, rays).rgb, picture.rgb, atol=2e-5, rtol=0)


def test_few_steps_are_enough_for_eight_bits() -> None:
    """The default against 64 times as many steps; alpha does not depend on them at all."""
    gaussians, rays = some(40, seed=2), some_rays(60)
    fine, coarse = (show(GaussianExactConfig(steps=steps), gaussians, rays) for steps in (1024, 32))
    assert float((fine.rgb - coarse.rgb).abs().max()) < 0.5 / 255
    torch.testing.assert_close(fine.alpha, coarse.alpha, atol=1e-12, rtol=0)


@pytest.mark.parametrize("a", [0.1, 0.5, 0.9])
def test_a_camera_inside_a_gaussian_sees_the_half_before_it(a: float) -> None:
    one = some(1, means=torch.zeros(1, 3, dtype=F64), opacities=torch.tensor([a], dtype=F64))
    rays = Rays.make(torch.zeros(1, 3, dtype=F64), torch.tensor([[0.6, 0.0, 0.8]], dtype=F64))
    ctx = Context(replace(BOUNDS, near=0.0))
    for config in (EXACT, SORTED):
        assert float(show(config, one, rays, ctx).alpha) == pytest.approx(1 - math.sqrt(1 - a), abs=1e-9)
    behind = some(1, means=torch.tensor([[-1.8, 0.0, -2.4]], dtype=F64), opacities=torch.tensor([a], dtype=F64))
    assert float(show(EXACT, behind, rays).alpha) < 1e-9


@pytest.mark.parametrize(
    "config",
    [
        replace(EXACT, steps=200),
        replace(EXACT, steps=200, opacity="extinction", self_attenuation=False),
        replace(SORTED, opacity="physical"),
        replace(SORTED, self_attenuation=False),
        SORTED,
    ],
    ids=str,
)
def test_gradients_are_those_of_finite_differences(config: Any) -> None:
    """Nodes of the quadrature move with the parameters and are held fixed in the gradient, which only costs its small error."""
    rays, names = some_rays(3), ("means", "quaternions", "scales", "opacities", "sh")
    start = some(3)
    weights = torch.randn(3, 3, dtype=F64, generator=torch.Generator().manual_seed(5))

    def value(*tensors: torch.Tensor) -> torch.Tensor:
        picture = show(config, Gaussians(**dict(zip(names, tensors, strict=True))), rays)
        return (picture.rgb * weights).sum() + picture.alpha.sum()

    inputs = [getattr(start, name).clone().requires_grad_(True) for name in names]
    gradients = torch.autograd.grad(value(*inputs), inputs)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for index, gradient in enumerate(gradients):
            direction = torch.randn(gradient.shape, dtype=F64, generator=generator)
            moved = [[*inputs[:index], inputs[index] + step * direction, *inputs[index + 1 :]] for step in (1e-5, -1e-5)]
            slope = (value(*moved[0]) - value(*moved[1])) / 2e-5
            assert float(slope) == pytest.approx(float((gradient * direction).sum()), rel=2e-3, abs=2e-4), names[index]


def test_pictures_are_the_rays_of_their_pixels(make_camera: Callable[..., Camera]) -> None:
    """Tiles and the search in cones lose nothing, also where a picture is no multiple of a tile."""
    field, camera = Fixed(some(60, scales=torch.rand(60, 3, dtype=F64) * 0.1 + 0.01)), make_camera(37, 21, 30.0)
    for config in (GaussianExactConfig(), GaussianSortedConfig("splat"), GaussianSortedConfig("physical")):
        renderer = config.build(None)
        picture, trace = renderer.render_image(field, camera, CTX)
        rays, _ = renderer.render_rays(field, camera.rays(), CTX)
        assert trace.rays == 37 * 21
        for name in ("rgb", "alpha", "depth", "normal"):
            torch.testing.assert_close(getattr(picture, name), getattr(rays.reshape(21, 37), name), atol=1e-10, rtol=0)


def test_centres_are_sorted_along_the_optical_axis(make_camera: Callable[..., Camera]) -> None:
    """A near centre far off the axis comes first by depth, although its ray meets the other Gaussian's middle before it."""
    pose = torch.eye(4, dtype=F64)
    camera = Camera(pose, torch.full((2,), 8.0, dtype=F64), torch.full((2,), 8.0, dtype=F64), 16, 16)
    means = torch.tensor([[1.2, 0.0, 2.0], [0.0, 0.0, 2.2]], dtype=F64)
    colours = torch.tensor([[[1.0, -1, -1]], [[-1.0, -1, 1]]], dtype=F64) * 2
    two = some(
        2, means=means, scales=torch.full((2, 3), 0.5, dtype=F64), opacities=torch.full((2,), 0.9, dtype=F64), sh=colours
    )
    by_ray, by_centre = (
        GaussianSortedConfig("splat", order).build(None).render_image(Fixed(two), camera, CTX)[0].rgb
        for order in ("ray", "centre")
    )
    assert float(by_centre[8, 9, 0] - by_ray[8, 9, 0]) > 0.01


def test_depth_and_normal_of_a_tilted_disc(make_camera: Callable[..., Camera]) -> None:
    """Where a ray meets the plane of a thin disc; the normal is the disc's, towards the camera; nothing where alpha < 0.5."""
    quaternion = torch.tensor([[0.9, 0.5, 0.1, -0.2]], dtype=F64)
    sizes = torch.tensor([[0.5, 0.6, 1e-4]], dtype=F64)
    disc = some(1, means=torch.zeros(1, 3, dtype=F64), quaternions=quaternion, scales=sizes, opacities=torch.ones(1, dtype=F64))
    normal, camera = quaternion_to_matrix(quaternion)[0, :, 2], make_camera(20, 20, 20.0)
    rays = camera.rays()
    expected = (-(rays.origins @ normal) / (rays.directions @ normal)).view(20, 20)
    facing = -normal * torch.sign(rays.directions[0] @ normal)
    for config in (GaussianExactConfig(), GaussianSortedConfig()):
        picture, _ = config.build(None).render_image(Fixed(disc), camera, CTX)
        seen = picture.alpha >= 0.5
        assert 20 < int(seen.sum()) < 400
        torch.testing.assert_close(picture.depth[seen], expected[seen], atol=1e-3, rtol=0)
        torch.testing.assert_close(picture.normal[seen], facing.expand(int(seen.sum()), 3))
        assert bool((picture.depth[~seen] == torch.inf).all()) and not bool(picture.normal[~seen].any())


@pytest.mark.parametrize(
    "config", [GaussianExactConfig(), GaussianSortedConfig(), GaussianSortedConfig("splat", "centre")], ids=str
)
def test_the_contract(config: Any) -> None:
    scene = toy_scene(views=2, size=12)
    torch.manual_seed(0)
    check_renderer(config.build(scene), GaussianFieldConfig(opacity=0.5, max_init=200).build(scene), scene)


def test_nothing_to_see(make_camera: Callable[..., Camera]) -> None:
    """No Gaussians, none on any ray, or no rays."""
    away = some(2, means=torch.full((2, 3), 50.0, dtype=F64))
    none = permuted(away, torch.zeros(0, dtype=torch.int64))
    for config in (GaussianExactConfig(), GaussianSortedConfig()):
        for gaussians in (away, none):
            picture, _ = config.build(None).render_image(Fixed(gaussians), make_camera(), CTX)
            assert not bool(picture.alpha.any()) and not bool(picture.rgb.any())
            assert bool((picture.depth == torch.inf).all())
        assert show(config, some(3), some_rays(0)).rgb.shape == (0, 3)


def test_float32_is_near_float64() -> None:
    scene, torch_scene = some(300, scales=torch.rand(300, 3, dtype=F64) * 0.05 + 0.002), toy_cameras(1, 32)[0]
    single = Gaussians(**{name: getattr(scene, name).float() for name in Gaussians.__dataclass_fields__})
    ctx = Context(BOUNDS.to(torch.float32))
    for config in (GaussianExactConfig(), GaussianSortedConfig("splat", "centre")):
        fine, _ = config.build(None).render_image(Fixed(scene), torch_scene.to(F64), ctx)
        rough, _ = config.build(None).render_image(Fixed(single), torch_scene, ctx)
        assert float((fine.rgb - rough.rgb.double()).abs().mean()) < 1e-5


@pytest.mark.parametrize(
    ("config", "settings"), [(GaussianExactConfig, {"steps": 0}), (GaussianSortedConfig, {"smallest": 0.0})]
)
def test_settings_out_of_range_are_refused(config: type, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        config(**settings)


@pytest.mark.parametrize("config", [EXACT, replace(EXACT, self_attenuation=False), SORTED])
def test_contributions_are_those_of_the_picture_where_the_near_plane_cuts_gaussians(config: Any) -> None:
    """The camera stands among them: their transmittances are shares, and the mean distance is the picture's depth."""
    gaussians = some(40, opacities=torch.full((40,), 0.95, dtype=F64))
    camera = Camera(torch.eye(4, dtype=F64), torch.full((2,), 8.0, dtype=F64), torch.full((2,), 4.0, dtype=F64), 8, 8)
    ctx = replace(CTX, bounds=replace(BOUNDS, near=0.2))
    renderer = config.build(toy_scene(2, 8))
    picture = renderer.render_image(Fixed(gaussians), camera, ctx)[0]
    compared = 0
    for column, row in itertools.product(range(8), range(8)):
        found = renderer.contributions(Fixed(gaussians), camera, (column, row), ctx)
        assert not len(found) or float(found.transmittance.max()) <= 1 + 1e-9
        if float(picture.alpha[row, column]) >= 0.5:
            assert found.expected_depth == pytest.approx(float(picture.depth[row, column]), rel=1e-3)
            compared += 1
    assert compared > 3
