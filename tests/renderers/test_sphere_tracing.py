"""Sphere tracing against closed forms of balls and boxes, and its gradients against finite differences."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Model, Quantity, Rays, Samples
from invgraphics.core.transforms import se3_exp
from invgraphics.errors import NotComposableError
from invgraphics.fields.analytic import Box, GaussianBlob, Sphere
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.renderers.neus import NeuSConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.sphere_tracing import SphereTracing, SphereTracingConfig
from invgraphics.testing import check_renderer, perturb, toy_scene

F64 = torch.float64
BOX = Bounds(torch.full((3,), -1.5, dtype=F64), torch.full((3,), 1.5, dtype=F64))


def tracing(**settings: float) -> SphereTracing:
    return SphereTracing(SphereTracingConfig(**settings))


class PaintedBall(Field):
    """A squeezed ball, whose distance is not exact, painted with waves; radius, centre and phase are parameters."""

    provides = Quantity.SDF | Quantity.GRADIENT | Quantity.RADIANCE

    def __init__(self) -> None:
        super().__init__()
        self.shape = nn.Parameter(torch.tensor([0.7, 0.1, -0.05, 0.08, 0.3], dtype=F64))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        radius, centre, phase = self.shape[0], self.shape[1:4], self.shape[4]
        stretch = torch.tensor([1.0, 1.25, 0.8], dtype=F64)
        offset = (samples.position - centre) * stretch
        waves = 3 * samples.position + phase + torch.tensor([0.0, 1.0, 2.0], dtype=F64)
        return FieldValues(
            sdf=offset.norm(dim=1) - radius,
            gradient=normalize(offset, dim=1) * stretch,
            radiance=0.5 + 0.3 * torch.sin(waves) + 0.2 * samples.direction,
        )


def ball_distance(rays: Rays, radius: float) -> tuple[Tensor, Tensor]:
    """Whether rays hit a ball around the origin, and where first."""
    middle = -(rays.origins * rays.directions).sum(dim=1)
    gap = radius**2 - (rays.origins.square().sum(dim=1) - middle**2)
    return gap > 0, middle - gap.clamp_min(0).sqrt()


def passing_rays(radius: float, count: int, start: float = -1.4) -> Rays:
    """Rays along x from ``start`` that pass a ball around the origin at 1e-6 to 0.1."""
    heights = radius + torch.logspace(-6, -1, count, dtype=F64)
    origins = torch.stack([torch.full_like(heights, start), heights, torch.zeros_like(heights)], dim=1)
    return Rays.make(origins, torch.tensor([[1.0, 0.0, 0.0]], dtype=F64).expand(count, 3))


@pytest.mark.parametrize("relaxation", [0.7, 1.0, 1.6])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_hits_of_a_ball(make_camera: Callable[..., Camera], relaxation: float, dtype: torch.dtype) -> None:
    camera = make_camera(40, 30, 40.0)
    hit, expected = ball_distance(camera.rays(), 0.8)
    ctx = Context(BOX.to(dtype), geometry=True)
    rendering, trace = tracing(relaxation=relaxation, steps=400).render_rays(
        Sphere(1.0, 0.8).to(dtype), camera.rays().to(dtype), ctx
    )
    assert trace.surface is not None
    assert 200 < int(hit.sum()) < 1000
    assert torch.equal(trace.surface.hit, hit)
    assert float((rendering.depth - expected)[hit].abs().max()) < 1e-4
    assert rendering.normal is not None
    points = camera.rays().at(expected)[hit]
    torch.testing.assert_close(rendering.normal[hit].to(F64), normalize(points, dim=1), atol=3e-4, rtol=0)
    assert bool(trace.surface.converged.all())


@pytest.mark.parametrize("relaxation", [1.0, 1.4])
def test_hits_of_a_box(make_camera: Callable[..., Camera], relaxation: float) -> None:
    camera, half = make_camera(40, 30, 40.0), torch.tensor([0.7, 0.3, 0.5], dtype=F64)
    rays = camera.rays()
    a, b = ((sign * half - rays.origins) / rays.directions for sign in (-1, 1))
    enter, leave = torch.minimum(a, b).amax(dim=1), torch.maximum(a, b).amin(dim=1)
    rendering, trace = tracing(relaxation=relaxation).render_rays(Box(1.0, half.tolist()).double(), rays, Context(BOX))
    assert trace.surface is not None
    assert 150 < int((leave > enter).sum()) < 1000
    assert torch.equal(trace.surface.hit, leave > enter)
    assert float((rendering.depth - enter)[leave > enter].abs().max()) < 1e-4


def test_opacity_is_the_sigmoid_of_the_least_distance(make_camera: Callable[..., Camera]) -> None:
    """Of a ball that is the distance of its centre from the ray, less the radius."""
    camera = make_camera(40, 30, 40.0)
    rays, sharpness = camera.rays(), 40.0
    renderer = tracing(final_sharpness=sharpness, refinements=24, steps=400)
    rendering, _ = renderer.render_rays(Sphere(1.0, 0.8).double(), rays, Context(BOX))
    middle = -(rays.origins * rays.directions).sum(dim=1)
    lowest = (rays.origins + middle[:, None] * rays.directions).norm(dim=1) - 0.8
    expected = torch.sigmoid(-sharpness / 1.5 * lowest)
    soft = (expected - 0.5).abs() < 0.49
    assert int(soft.sum()) > 100
    # It is stretched by 3e-4 at both ends, to reach 0 and 1.
    torch.testing.assert_close(rendering.alpha, expected, atol=5e-4, rtol=0)


def test_over_relaxation_does_not_skip_a_thin_slab() -> None:
    """A ray that comes from afar, past the edge of a big box whose distance is large, onto a slab 2e-3 thick."""
    angles = torch.linspace(-0.5, 0.5, 41, dtype=F64)
    directions = torch.stack([angles.sin(), angles.cos(), torch.zeros_like(angles)], dim=1)
    rays = Rays.make(torch.tensor([[0.013, -1.4, 0.0]], dtype=F64).expand(41, 3), directions)
    slab = Box(1.0, (5.0, 1e-3, 5.0)).double()
    for relaxation in (1.0, 1.3, 1.6, 1.9):
        rendering, trace = tracing(relaxation=relaxation, final_sharpness=1e5).render_rays(slab, rays, Context(BOX))
        assert trace.surface is not None
        assert bool(trace.surface.hit.all()), relaxation
        expected = (1.4 - 1e-3) / directions[:, 1]
        torch.testing.assert_close(rendering.depth, expected, atol=1e-4, rtol=0)


def test_over_relaxation_saves_look_ups_at_grazing_rays() -> None:
    floor = Box(1.0, (5.0, 0.5, 5.0), centre=(0.0, -0.5, 0.0)).double()
    heights = torch.linspace(0.05, 0.3, 20, dtype=F64)
    origins = torch.stack([torch.full_like(heights, -1.4), heights, torch.zeros_like(heights)], dim=1)
    rays = Rays.make(origins, normalize(torch.tensor([[1.0, -0.1, 0.0]], dtype=F64), dim=1).expand(20, 3))
    steps = []
    for relaxation in (1.0, 1.7):
        _, trace = tracing(relaxation=relaxation, steps=500).render_rays(floor, rays, Context(BOX))
        assert trace.surface is not None
        assert bool(trace.surface.converged.all())
        steps.append(float(trace.surface.steps.double().mean()))
    assert steps[1] < 0.75 * steps[0]


def test_steps_are_bounded_and_rays_that_used_them_up_are_marked() -> None:
    looked: list[int] = []

    class Counting(Sphere):
        def query(self, samples: Samples, want: Quantity) -> FieldValues:
            looked.append(len(samples))
            return super().query(samples, want)

    # Rays that pass the ball closely take many short steps.
    rays = passing_rays(0.8, 30)
    _, trace = tracing(steps=12, refinements=3).render_rays(Counting(1.0, 0.8).double(), rays, Context(BOX))
    assert trace.surface is not None
    assert int(trace.surface.steps.max()) == 12
    assert len(looked) <= 12 + 2 * 3 + 2
    assert looked[:12] == sorted(looked[:12], reverse=True)
    assert looked[11] < looked[0], "finished rays are looked up again"
    assert not bool(trace.surface.converged.all())
    assert not bool(trace.surface.hit.any())


@pytest.mark.parametrize("least", [1e-4, 1e-3, 3e-3])
def test_shortest_steps_are_not_taken_again(least: float) -> None:
    """In float32 a shortest step may come out a little longer than it should be: that does not make it an over-relaxed one."""
    rays = passing_rays(0.8, 200, start=-30.0).to(torch.float32)
    _, trace = tracing(least_step=least, steps=3000).render_rays(Sphere(1.0, 0.8), rays, Context(BOX.to(torch.float32)))
    assert trace.surface is not None
    assert bool(trace.surface.converged.all())


def test_a_camera_inside_a_solid_and_one_inside_a_hollow() -> None:
    rays = Rays.make(torch.zeros(4, 3, dtype=F64), normalize(torch.randn(4, 3, dtype=F64), dim=1))
    solid = Sphere(1.0, 0.8).double()
    rendering, _ = tracing().render_rays(solid, rays, Context(BOX))
    torch.testing.assert_close(rendering.depth, torch.full((4,), BOX.near, dtype=F64))
    assert float(rendering.alpha.min()) > 0.99

    class Hollow(Sphere):
        def sdf_at(self, position: Tensor) -> Tensor:
            return -super().sdf_at(position)

        def query(self, samples: Samples, want: Quantity) -> FieldValues:
            values = super().query(samples, want)
            return replace(values, gradient=None if values.gradient is None else -values.gradient)

    rendering, _ = tracing().render_rays(Hollow(1.0, 0.8).double(), rays, Context(BOX))
    torch.testing.assert_close(rendering.depth, torch.full((4,), 0.8, dtype=F64), atol=1e-5, rtol=0)


def test_an_empty_scene_and_rays_that_miss_the_bounds(make_camera: Callable[..., Camera]) -> None:
    rays = make_camera(12, 10, 5.0).rays()
    missing = BOX.clip(rays).far <= BOX.clip(rays).near
    assert 10 < int(missing.sum()) < 110
    field = Sphere(1.0, 0.1, centre=(0.0, 0.0, 40.0)).double()
    ctx = Context(BOX, geometry=True, training=True)
    rendering, trace = tracing().render_rays(field, rays, ctx)
    assert not bool(rendering.alpha.any())
    assert not bool(rendering.rgb.any())
    assert bool(rendering.depth.isposinf().all())
    assert trace.surface is not None
    assert int(trace.surface.steps[missing].max()) == 0
    assert len(trace.samples or ()) == 0


@pytest.mark.parametrize("what", ["colour", "depth", "silhouette"])
@pytest.mark.parametrize("of", ["field", "pose"])
def test_gradients_equal_finite_differences(make_camera: Callable[..., Camera], what: str, of: str) -> None:
    camera, field = make_camera(14, 12, 18.0), PaintedBall()
    renderer = tracing(final_sharpness=30.0, refinements=40, tolerance=1e-12, least_step=1e-6, steps=400)
    weights = torch.randn(168, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    # Away from silhouettes, where hits move infinitely fast; near them for opacity, which is cut off elsewhere.
    kept: list[Tensor] = []

    def value(shape: Tensor, twist: Tensor) -> Tensor:
        pose = se3_exp(twist) @ camera.cam_to_world
        moved = PaintedBall()
        del moved.shape
        moved.shape = shape  # type: ignore[assignment]
        rendering, _ = renderer.render_rays(moved, camera.moved(pose).rays(), Context(BOX, training=True))
        if not kept:
            lowest = rendering.alpha.detach().logit()
            kept.append(lowest.abs() < 5 if what == "silhouette" else lowest > 6)
        assert int(kept[0].sum()) > 8
        if what == "colour":
            return (weights * rendering.rgb)[kept[0]].sum()
        return (weights[:, 0] * (rendering.depth if what == "depth" else rendering.alpha))[kept[0]].sum()

    start = [field.shape.detach().clone(), torch.zeros(6, dtype=F64)]
    which, step = (0 if of == "field" else 1), 1e-6
    leaves = [part.requires_grad_(index == which) for index, part in enumerate(start)]
    (gradient,) = torch.autograd.grad(value(leaves[0], leaves[1]), leaves[which])
    for index in range(len(gradient)):
        ends = []
        for sign in (1, -1):
            moved = [part.detach().clone() for part in start]
            moved[which][index] += sign * step
            with torch.no_grad():
                ends.append(value(moved[0], moved[1]))
        expected = float(ends[0] - ends[1]) / (2 * step)
        assert float(gradient[index]) == pytest.approx(expected, rel=2e-3, abs=2e-4), index
    assert float(gradient.norm()) > 0.05


def test_contributions_are_the_one_surface_point(make_camera: Callable[..., Camera]) -> None:
    camera, field, renderer = make_camera(), Sphere(1.0, 0.8, colour=(0.2, 0.5, 0.8)).double(), tracing()
    found = renderer.contributions(field, camera, (6, 5), Context(BOX))
    picture, _ = renderer.render_image(field, camera, Context(BOX))
    assert found.kind == "surface points"
    torch.testing.assert_close(found.colour, picture.rgb[5, 6])
    torch.testing.assert_close(found.t[0], picture.depth[5, 6])
    assert len(renderer.contributions(field, camera, (0, 0), Context(BOX))) == 0


def test_one_distance_has_the_depths_of_volume_rendering_as_its_density_sharpens() -> None:
    """A neural distance through sphere tracing and NeuS, as `--render-with` shows it: the sharper s, the closer the depths."""
    torch.manual_seed(0)
    scene = toy_scene(views=2, size=24)
    field = NeuralFieldConfig(FrequencyConfig(3), "sdf", layers=2, width=32, skip=-1, geometry_features=3).build(scene)
    perturb(field, 0.003)
    camera, gaps = scene.test[0].camera, []
    traced = Model(field, SphereTracingConfig(steps=200).build(scene).untrained(), scene.bounds).render(camera)
    for sharpness in (20.0, 100.0, 500.0):
        neus = NeuSConfig(StratifiedConfig(512), sharpness=sharpness, change="held").build(scene).untrained()
        volume = Model(field, neus, scene.bounds).render(camera)
        both = (traced.alpha > 0.99) & (volume.alpha > 0.99)
        assert int(both.sum()) > 15
        gaps.append(float((traced.depth - volume.depth)[both].abs().median()))
    assert gaps[0] > 2 * gaps[1] > 4 * gaps[2], gaps
    assert gaps[2] < 5e-3


class Painted(Sphere):
    """A ball whose colour is that of the place: of an even one no pixel would have a gradient to the pose."""

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        return values if values.radiance is None else replace(values, radiance=samples.position.sigmoid() * self.colour)


def test_the_contract() -> None:
    scene = toy_scene(views=2, size=8)
    check_renderer(tracing(), Painted(1.0, 0.6), scene)
    with pytest.raises(NotComposableError, match="sdf, gradient"):
        check_renderer(tracing(), GaussianBlob(1.0, 1.0), scene)


@pytest.mark.parametrize(
    "bad", [{"steps": 0}, {"relaxation": 2.0}, {"relaxation": 0.0}, {"tolerance": 0.0}, {"refinements": -1}, {"sharp_at": 0.0}]
)
def test_settings_out_of_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        SphereTracingConfig(**bad)


def test_sharpness_rises_exponentially() -> None:
    config = SphereTracingConfig(sharpness=10.0, final_sharpness=1000.0, sharp_at=0.5)
    assert [config.sharpness_at(p) for p in (0.0, 0.25, 0.5, 1.0)] == pytest.approx([10.0, 100.0, 1000.0, 1000.0])


def test_contracted_space_is_traced() -> None:
    bounds = Bounds(BOX.lo, BOX.hi, "contracted")
    direction = normalize(torch.tensor([[0.3, 5.0, -0.4]], dtype=F64), dim=1)
    ball = Sphere(1.0, 0.5, centre=(5 * direction[0]).tolist()).double()
    rays = Rays.make(torch.zeros(1, 3, dtype=F64), direction)
    rendering, _ = tracing().render_rays(ball, rays, Context(bounds))
    assert float(rendering.depth) == pytest.approx(4.5, abs=1e-5)
