"""Densities made from distances: VolSDF and NeuS on planes and spheres, against closed forms and finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Quantity, Rays, Samples
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.distance_density import LaplaceDensity, LogisticDensity, laplace_density, neighbour_slopes
from invgraphics.renderers.hybrid import Hybrid
from invgraphics.renderers.neus import NeuSConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volsdf import VolSDFConfig
from invgraphics.testing import toy_scene

ANGLES = (0.0, 0.4, 0.8, 1.2, 1.5)
"""Between a ray and a plane's normal, radians."""


class Plane(Field):
    """Half space below z = 0, with an exact distance."""

    provides = Quantity.SDF | Quantity.GRADIENT | Quantity.NORMAL | Quantity.RADIANCE

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        up = samples.position.new_tensor([0.0, 0.0, 1.0]).expand(len(samples), 3)
        return FieldValues(sdf=samples.position[:, 2], gradient=up, normal=up, radiance=torch.ones_like(up))


class WavyBall(Field):
    """A ball of a learnt radius, painted with waves; its distance is not exact, so that gradients have other lengths than 1."""

    provides = Quantity.SDF | Quantity.GRADIENT | Quantity.NORMAL | Quantity.RADIANCE

    def __init__(self) -> None:
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(0.7, dtype=torch.float64))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        scaled = samples.position * samples.position.new_tensor([1.0, 1.2, 0.9])
        gradient = normalize(scaled, dim=1) * samples.position.new_tensor([1.0, 1.2, 0.9])
        paint = 0.5 + 0.5 * torch.sin(4 * samples.position + samples.position.new_tensor([0.0, 1.0, 2.0]))
        return FieldValues(
            sdf=scaled.norm(dim=1) - self.radius, gradient=gradient, normal=normalize(gradient, dim=1), radiance=paint
        )


def box(half: float = 1.0) -> Bounds:
    corner = torch.full((3,), half, dtype=torch.float64)
    return Bounds(-corner, corner, near=0.0)


def ray_at(angle: float, length: float = 1.0) -> Rays:
    """One ray through the origin at an angle to +z, that starts ``length`` before it and ends as far behind."""
    direction = torch.tensor([[math.sin(angle), 0.0, -math.cos(angle)]], dtype=torch.float64)
    return Rays.make(-length * direction, direction).within(direction.new_zeros(1), direction.new_full((1,), 2 * length))


def volsdf(count: int, **settings: object) -> Hybrid:
    config = VolSDFConfig(StratifiedConfig(count), change="held", **settings)  # type: ignore[arg-type]
    return config.build(toy_scene(views=2, size=4)).double()


def neus(count: int, **settings: object) -> Hybrid:
    config = NeuSConfig(StratifiedConfig(count), change="held", **settings)  # type: ignore[arg-type]
    return config.build(toy_scene(views=2, size=4)).double()


def weights_on(renderer: Hybrid, field: Field, rays: Rays, bounds: Bounds) -> tuple[Tensor, Samples]:
    _, trace = renderer.render_rays(field, rays, Context(bounds))
    assert trace.weights is not None
    assert trace.samples is not None
    return trace.weights.detach(), trace.samples


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("sharpness", [10.0, 80.0])
def test_neus_weights_on_a_plane_are_differences_of_the_sigmoid(angle, sharpness):
    """T(t) = Φ(f(t)) / Φ(f(0)) at any angle, so a weight is Φ(f0) - Φ(f1) over Φ(f(0)): exactly, however long the interval."""
    rays, bounds = ray_at(angle), box()
    weights, samples = weights_on(neus(23, sharpness=sharpness), Plane(), rays, bounds)
    phi = lambda t: torch.sigmoid(sharpness * (rays.origins + t[:, None] * rays.directions)[:, 2])  # noqa: E731
    expected = (phi(samples.t0) - phi(samples.t1)) / phi(torch.zeros_like(samples.t0))
    torch.testing.assert_close(weights, expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_neus_is_unbiased_and_laplace_is_not(angle):
    """Where half of the light is gone: at the plane for NeuS (equation 13), before it for VolSDF at grazing angles."""
    width, cosine, rays, bounds = 0.005, math.cos(angle), ray_at(angle, 2.0), box(2.0)
    settings = [(neus(4000, sharpness=2 / width), 0.0)]
    if 2 * cosine * math.log(2) < 1:
        settings.append((volsdf(4000, beta=width / 2), width * math.log(1 / (2 * cosine * math.log(2))) / cosine))
    for renderer, offset in settings:
        weights, samples = weights_on(renderer, Plane(), rays, bounds)
        half = samples.t1[int((weights.cumsum(0) >= 0.5).nonzero()[0, 0])]
        assert float(2.0 - half) == pytest.approx(offset, abs=2e-3)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("count", "sections"), [(4000, False), (23, True)])
def test_volsdf_transmittance_on_a_plane(angle, count, sections):
    """With sections exactly, however long the interval.

    Optical depth up to distance f is G(f) / cos, with the tail integral G of Ψ(-f) / β: e^(-f/β) / 2 before the plane."""
    beta, rays = 0.05, ray_at(angle)
    weights, samples = weights_on(volsdf(count, beta=beta, sections=sections), Plane(), rays, box())
    f = (rays.origins + samples.t1[:, None] * rays.directions)[:, 2]
    tail = lambda x: 0.5 * torch.exp(-x.abs() / beta) + (-x).clamp_min(0) / beta  # noqa: E731
    start = tail(rays.origins[:, 2])
    expected = 1 - torch.exp(-(tail(f) - start) / math.cos(angle))
    torch.testing.assert_close(weights.cumsum(0), expected, rtol=0, atol=1e-6 if sections else 2e-4)


def test_sections_take_the_bias_of_long_steps_away():
    """A plane at all depths within a step much longer than β: in the mean seen half a step too far without sections."""
    count, beta, errors = 40, 1e-4, []
    step = 2 / count
    height = 1 - step * (torch.arange(20, dtype=torch.float64) + 0.25) / 20
    origins = torch.stack([torch.zeros_like(height), torch.zeros_like(height), height], dim=1)
    down = origins.new_tensor([0.0, 0.0, -1.0]).expand(20, 3)
    rays = Rays.make(origins, down).within(torch.zeros_like(height), torch.full_like(height, 2.0))
    for sections in (False, True):
        rendering, _ = volsdf(count, beta=beta, sections=sections).render_rays(Plane(), rays, Context(box(1.1)))
        errors.append(float((rendering.depth - height).mean()))
    assert errors == pytest.approx([step / 2, 0], abs=0.05 * step)


@pytest.mark.parametrize("make", ["volsdf", "neus"])
def test_depth_tends_to_the_surface_as_the_width_falls(make):
    """On a sphere: hits at all distances from the middle of the picture, errors that fall with the width, alpha 0 or 1."""
    field, bounds = Sphere(1.0, 0.6).double(), box()
    offset = torch.tensor([0.0, 0.2, 0.4, 0.55, 0.8], dtype=torch.float64)
    origins = torch.stack([offset, torch.zeros(5).double(), torch.full((5,), -3.0).double()], dim=1)
    rays = along_z(origins)
    hit = 3 - (0.36 - offset[:4].square()).sqrt()
    errors = []
    for width in (0.02, 0.005, 0.00125):
        renderer = volsdf(6000, beta=width) if make == "volsdf" else neus(6000, sharpness=1 / width)
        rendering, _ = renderer.render_rays(field, rays, Context(bounds))
        errors.append((rendering.depth[:4] - hit).abs().max())
        # A grazing ray passes through more of the density than it is deep.
        assert float(rendering.alpha[:3].min()) > 0.95
        assert float(rendering.alpha[4]) < 1e-3
    assert float(errors[2].detach()) < 0.005
    assert errors[2] < errors[1] / 2 < errors[0] / 4


def along_z(origins: Tensor) -> Rays:
    n = len(origins)
    direction = origins.new_tensor([0.0, 0.0, 1.0]).expand(n, 3)
    return Rays(
        origins, direction, origins.new_zeros(n), origins.new_full((n,), 10.0), origins.new_zeros(n), torch.full((n,), -1)
    )


def test_laplace_density_is_the_derivative_of_its_optical_depth():
    """Far from the surface, at it and inside; an independent integral by Simpson's rule."""
    beta, sdf = torch.tensor(0.1).double(), torch.linspace(-0.8, 0.8, 1601, dtype=torch.float64)
    density = laplace_density(sdf, beta)
    step = float(sdf[1] - sdf[0])
    simpson = (density[:-2:2] + 4 * density[1:-1:2] + density[2::2]).sum() * step / 3
    assert float(simpson) == pytest.approx(0.8 / 0.1, rel=1e-4)  # symmetric about 1 / (2 beta)
    assert float(density[800]) == pytest.approx(5.0)
    assert float(density[0]) == pytest.approx(10.0, rel=1e-3)
    assert float(laplace_density(torch.tensor(2.0), torch.tensor(0.1))) == pytest.approx(5 * math.exp(-20), rel=1e-4)


def test_logistic_density_of_short_intervals_is_that_of_points():
    samples = Samples.on(ray_at(0.5), torch.zeros(50, dtype=torch.long), *torch.linspace(0.5, 1.5, 100).double().split(50))
    points, short = (replace(samples, t1=samples.t0 + d, position=samples.position) for d in (0.0, 1e-6))
    field = LogisticDensity(Plane(), torch.tensor(0.05).double())
    one, other = (field.query(s, Quantity.DENSITY).density for s in (points, short))
    torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-8)


def test_slopes_of_neighbours_are_those_of_the_gradient_on_a_plane():
    samples = Samples.on(ray_at(0.7), torch.zeros(9, dtype=torch.long), *torch.linspace(0, 1.8, 18).double().split(9))
    slopes = neighbour_slopes(Plane().query(samples, Quantity.SDF).sdf, samples)
    torch.testing.assert_close(slopes, torch.full_like(slopes, -math.cos(0.7)))
    lone = Samples.on(ray_at(0.7), torch.zeros(1, dtype=torch.long), torch.tensor([0.1]).double(), torch.tensor([0.2]).double())
    assert float(neighbour_slopes(lone.position[:, 2], lone)) == -1


@pytest.mark.parametrize("make", [volsdf, neus])
def test_gradients_in_parameters_pose_and_width(make, make_camera):
    """Directional derivatives of colours and alpha, by central differences in float64."""
    renderer, field, camera = make(24), WavyBall(), make_camera(width=5, height=4, focal=6.0)
    renderer._settings = replace(renderer._settings, change="learnt")
    bounds, weight = box(), torch.rand(4, 5, 4, dtype=torch.float64)

    def value(pose: Tensor) -> Tensor:
        rendering, _ = renderer.render_image(field, camera.moved(pose), Context(bounds))
        return (torch.cat([rendering.rgb, rendering.alpha[..., None]], dim=-1) * weight).sum()

    pose = camera.cam_to_world.clone().requires_grad_()
    inputs = (pose, field.radius, renderer.width)
    gradients = torch.autograd.grad(value(pose), inputs)
    for number, (tensor, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        along = torch.randn_like(tensor)
        if number == 0:
            along[:, :3] = 0  # positions only: a pose stays rigid
        ends = []
        with torch.no_grad():
            for sign in (1, -1):
                tensor.add_(sign * 1e-6 * along)
                ends.append(value(pose))
                tensor.sub_(sign * 1e-6 * along)
        expected = (ends[0] - ends[1]) / 2e-6
        torch.testing.assert_close((gradient * along).sum(), expected, rtol=2e-4, atol=1e-7)
        assert abs(float(expected)) > 1e-3


@pytest.mark.parametrize("make", ["volsdf", "neus"])
def test_normals_are_those_of_the_ball(make):
    """Where rays of a camera meet it, up to its silhouette, in the scene's axes and towards the camera."""
    camera = toy_scene(views=1, size=40, zoom=1.3).train[0].camera.to(torch.float64)
    renderer = volsdf(400, beta=0.01) if make == "volsdf" else neus(400, sharpness=200.0)
    rays = camera.rays()
    towards = (rays.origins * rays.directions).sum(dim=1)
    under = towards**2 - rays.origins.square().sum(dim=1) + 0.6**2
    clear = under > 0.01  # a ray that grazes the ball sees its fuzzy edge
    ball = Sphere(1.0, 0.6).double()
    rendering, _ = renderer.render_rays(ball, rays, Context(box(), geometry=True))
    expected = normalize(rays.origins + (-towards - under.clamp_min(0).sqrt())[:, None] * rays.directions, dim=1)
    assert int(clear.sum()) > 100
    error = torch.rad2deg((rendering.normal * expected).sum(dim=1)[clear].clamp(-1, 1).acos())
    assert float(error.mean()) < 1 and float(error.max()) < 5


@pytest.mark.parametrize("make", ["volsdf", "neus"])
def test_what_becomes_of_the_width(make):
    scene, field = toy_scene(views=2, size=4), Sphere(1.0, 0.5)
    config = VolSDFConfig if make == "volsdf" else NeuSConfig
    first, last = (0.1, 0.002) if make == "volsdf" else (1 / 20, 1 / 1000)
    for change in ("learnt", "scheduled", "held"):
        renderer = config(StratifiedConfig(8), change=change).build(scene)
        ctx = Context(Bounds(-torch.full((3,), 2.0), torch.full((3,), 2.0)), training=True, progress=0.5)
        assert float(renderer.beta(ctx).detach()) == pytest.approx(2 * first, rel=1e-4)  # of half-extents of 2
        rendering, _ = renderer.render_image(field, scene.train[0].camera, ctx)
        rendering.alpha.sum().backward()
        assert (renderer.width.grad is not None) == (change == "learnt")
        renderer.update(field, ctx)
        now = first if change != "scheduled" else math.sqrt(first * last)
        assert float(renderer.beta(ctx).detach()) == pytest.approx(2 * now, rel=1e-3)
        constant = first if change == "held" else last
        stand_in = renderer.untrained()
        assert float(stand_in.beta(ctx).detach()) == pytest.approx(2 * constant, rel=1e-3)
        stand_in.load_state_dict(renderer.state_dict())
        assert float(stand_in.beta(ctx).detach()) == pytest.approx(2 * now, rel=1e-3)


@pytest.mark.parametrize("make", ["volsdf", "neus"])
def test_a_schedule_ends_at_the_width_of_pixels(make):
    """The distribution behind a density deviates by a given share of a pixel, by quadrature; sharper it gets on no schedule."""
    scene = toy_scene(views=2, size=4)
    pose = torch.eye(4)
    pose[2, 3] = -400.0
    far = Camera(pose, torch.tensor([5000.0, 5000.0]), torch.tensor([2.0, 2.0]), 4, 4)
    scene = replace(scene, train=(replace(scene.train[0], camera=far),), bounds=Bounds(-torch.ones(3), torch.ones(3) * 2.0))
    config, sharp = (VolSDFConfig, {"beta_final": 2e-4}) if make == "volsdf" else (NeuSConfig, {"sharpness_final": 1e4})
    wide = {"beta": 0.2, "beta_final": 0.2} if make == "volsdf" else {"sharpness": 5.0, "sharpness_final": 5.0}

    def deviation(**settings) -> float:
        renderer = config(StratifiedConfig(8), **settings).build(scene)
        ctx = Context(scene.bounds, training=True, progress=1.0)
        renderer.update(Sphere(1.0, 0.5), ctx)
        sdf, width = torch.linspace(-9, 9, 1_000_001, dtype=torch.float64), renderer.beta(ctx).detach().double()
        cdf = laplace_density(-sdf, width) * width if make == "volsdf" else torch.sigmoid(sdf / width)
        return float((cdf.diff() * ((sdf[1:] + sdf[:-1]) / 2).square()).sum().sqrt())

    pixel = 400.0 / 5000.0
    for share in (0.3, 0.6):
        found = deviation(**sharp, change="scheduled", min_deviation=share)
        assert found == pytest.approx(share * pixel, rel=0.01)
    assert deviation(**sharp, change="scheduled") < 0.03 * pixel
    assert deviation(**wide, change="scheduled", min_deviation=0.3) > pixel  # as wide as it was asked for
    start = {"beta": 0.001} if make == "volsdf" else {"sharpness": 1000.0}
    assert deviation(**start, change="held", min_deviation=0.3) < 0.1 * pixel
    with pytest.raises(ValueError, match="min_deviation"):
        config(min_deviation=-1.0)


@pytest.mark.parametrize("config", [VolSDFConfig, NeuSConfig])
def test_the_occupancy_sampler_is_fed_by_the_distance(config):
    """Cells far outside are given up, those of the surface and inside are not, and the picture stays what it was."""
    scene, field = toy_scene(views=2, size=16), Sphere(1.0, 0.5)
    sampler = OccupancyConfig(resolution=16, steps_per_diagonal=512, threshold=1e-5)
    sharp = {"beta": 0.02} if config is VolSDFConfig else {"sharpness": 50.0}
    renderer = config(sampler, **sharp).build(scene)
    ctx = Context(scene.bounds)
    before, _ = renderer.render_image(field, scene.test[0].camera, ctx)
    for _ in range(60):
        renderer.update(field, ctx)
    occupied = renderer.volumetric.sampler.occupied
    middle = (torch.stack(torch.meshgrid(*[torch.arange(16)] * 3, indexing="ij"), dim=-1) + 0.5) / 8 - 1
    distance = middle.norm(dim=-1) - 0.5
    assert not bool(occupied[distance > 0.35].any())
    assert bool(occupied[distance < 0].all())
    after, _ = renderer.render_image(field, scene.test[0].camera, ctx)
    torch.testing.assert_close(before.alpha, after.alpha, rtol=0, atol=5e-3)
    dense, _ = (
        replace(renderer.config, sampler=StratifiedConfig(512)).build(scene).render_image(field, scene.test[0].camera, ctx)
    )
    torch.testing.assert_close(dense.rgb, after.rgb, rtol=0, atol=1e-2)


def test_a_ray_that_leaves_a_surface_meets_it_only_while_annealed():
    """Upwards through the plane from below: NeuS's density is zero there, but for the start of an annealed fit."""
    rays = ray_at(0.3)
    rays = replace(rays, origins=-rays.origins, directions=-rays.directions)
    samples = Samples.on(rays, torch.zeros(40, dtype=torch.long), *torch.linspace(0, 2, 41).double().unfold(0, 2, 1).unbind(1))
    at = lambda anneal: LogisticDensity(Plane(), torch.tensor(0.05).double(), anneal=anneal).density_no_grad(samples)  # noqa: E731
    assert not at(1.0).any()
    assert float(at(0.0).max()) > 0.1
    assert Quantity.DENSITY in LaplaceDensity(Plane(), torch.tensor(0.1)).provides


@pytest.mark.parametrize("config", [VolSDFConfig, NeuSConfig])
def test_samples_of_no_weight_are_left_out_in_training_only(config):
    """By the sampler's own densities; what is left weighs something, and makes the same picture but for the threshold."""
    scene, field = toy_scene(views=2, size=16), Sphere(1.0, 0.5)
    sampler, sharp = OccupancyConfig(resolution=16, steps_per_diagonal=256), {"beta": 0.01, "sharpness": 100.0}
    sharp = {key: value for key, value in sharp.items() if hasattr(config, key)}
    every, some = (config(sampler, weight_threshold=w, **sharp).build(scene) for w in (0.0, 1e-3))
    camera, kept, pictures = scene.train[0].camera, [], []
    for training in (True, False):
        for renderer in (every, some):
            ctx = Context(scene.bounds, training=training, generator=torch.Generator().manual_seed(3))
            rendering, trace = renderer.render_rays(field, camera.rays(), ctx)
            kept.append(len(trace.weights))
            pictures.append(rendering.alpha.detach())
    assert kept[1] < 0.3 * kept[0]
    assert kept[2] == kept[3]
    # Rays at the rim have hundreds of samples near the threshold.
    torch.testing.assert_close(pictures[0], pictures[1], rtol=0, atol=0.06)
    assert float((pictures[0] - pictures[1]).abs().mean()) < 0.01
    assert torch.equal(pictures[2], pictures[3])
    assert some.untrained().volumetric.sampler.threshold == 1e-3
    assert some.required == every.required


@pytest.mark.parametrize("config", [VolSDFConfig, NeuSConfig])
def test_rays_through_emptiness_keep_their_heaviest_sample(config):
    """So that a loss can say there should be something: the ball is too small for the threshold at every sample."""
    scene, field = toy_scene(views=2, size=16), Sphere(1.0, 0.02)
    sampler, wide = OccupancyConfig(resolution=16, steps_per_diagonal=64), {"beta": 0.02, "sharpness": 50.0}
    wide = {key: value for key, value in wide.items() if hasattr(config, key)}
    renderer = config(sampler, weight_threshold=0.9, **wide).build(scene)
    rays = scene.train[0].camera.rays()
    ctx = Context(scene.bounds, training=True, generator=torch.Generator().manual_seed(3))
    rendering, trace = renderer.render_rays(field, rays, ctx)
    assert trace.samples is not None
    counts = torch.bincount(trace.samples.ray, minlength=len(rays))
    all_weights = config(sampler, weight_threshold=0.0, **wide).build(scene).render_rays(field, rays, ctx)[0].alpha
    assert counts.max() == 1
    assert bool((counts[all_weights > 1e-6] == 1).all())
    assert bool((rendering.alpha <= all_weights + 1e-6).all())
