"""Early termination: what is left out, what is asked for its colour, and that the picture hardly notices."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Context, FieldValues, Quantity, Rays, Samples, Scene
from invgraphics.fields.analytic import GaussianBlob, Sphere
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.kernels.types import March
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.termination import Query, contributing_samples, visible_samples
from invgraphics.renderers.volumetric import MAX_SKIPPED_WEIGHT, Volumetric

STOPPING = OccupancyConfig(resolution=8, steps_per_diagonal=128, stop="evaluation")


def dense(function) -> Query:
    """Samples to density, as a query."""
    return lambda samples: FieldValues(density=function(samples))


def marched(counts: list[int]) -> tuple[Rays, March]:
    """Unit intervals, ``counts`` of them per ray."""
    rays = Rays.make(torch.zeros(len(counts), 3), torch.tensor([[0.0, 0.0, 1.0]]).expand(len(counts), 3))
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    t0 = torch.cat([torch.arange(count, dtype=torch.float32) for count in counts])
    return rays, March(ray, t0, t0 + 1, rays.far)


@pytest.mark.parametrize("chunk", [1, 2, 5, 100, None])
def test_keeps_what_light_reaches(chunk: int | None) -> None:
    """Density 1 everywhere: light e^-k reaches interval k, so that 5 intervals see more than e^-4.5."""
    rays, march = marched([0, 3, 40, 1, 17])
    samples = visible_samples(rays, march, dense(lambda s: torch.ones(len(s))), 0.0111, chunk)
    assert torch.bincount(samples.ray, minlength=5).tolist() == [0, 3, 5, 1, 5]
    assert samples.t0.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 0, 0, 1, 2, 3, 4]
    assert samples.density is not None
    assert samples.density.tolist() == [1.0] * 14


def test_hides_what_is_behind_an_infinite_density_only() -> None:
    rays, march = marched([6])
    samples = visible_samples(rays, march, dense(lambda s: torch.where(s.t0 == 3, torch.inf, 0.1)), 1e-3, 2)
    assert samples.t0.tolist() == [0, 1, 2, 3]


def test_without_a_limit_everything_is_kept() -> None:
    rays, march = marched([4, 9])
    samples = visible_samples(rays, march, dense(lambda s: 50 + s.t0), 0.0, 3)
    assert torch.equal(samples.t0, march.t0)
    assert torch.equal(samples.ray, march.ray)
    assert samples.density is not None
    assert torch.equal(samples.density, 50 + march.t0)


def test_few_looks_even_where_nothing_is_opaque() -> None:
    rays, march = marched([600])
    looks = []
    visible_samples(rays, march, dense(lambda s: looks.append(len(s)) or torch.zeros(len(s))), 1e-3, 6)
    assert sum(looks) == 600
    assert len(looks) <= 12


def test_what_is_not_looked_at_weighs_little() -> None:
    ray = torch.repeat_interleave(torch.arange(50), torch.randint(0, 40, (50,)))
    weights = torch.rand(len(ray)) ** 12 / 20
    seen = contributing_samples(weights, ray, 50, 0.01)
    left = weights.index_fill(0, seen, 0.0)
    assert 0 < len(seen) < len(ray)
    assert float(torch.zeros(50).index_add(0, ray, left).max()) <= 0.01
    assert contributing_samples(weights, ray, 50, 0.0).tolist() == torch.nonzero(weights)[:, 0].tolist()


def test_colours_are_asked_of_few_and_the_picture_stays(make_scene: Callable[..., Scene]) -> None:
    scene, asked = make_scene(), []

    class Spy(GaussianBlob):
        def query(self, samples: Samples, want: Quantity):
            asked.append((len(samples), want))
            return super().query(samples, want)

    field = Spy(60.0, 0.04, colour=(0.2, 0.5, 0.9))
    rays, ctx = scene.train[0].camera.rays(), Context(scene.bounds, geometry=True)
    renderer = Volumetric(STOPPING.build(scene))
    whole, trace = Volumetric(replace(STOPPING, stop="never").build(scene)).render_rays(field, rays, ctx)
    whole = whole.detach()
    assert trace.samples is not None
    with torch.no_grad():
        asked.clear()
        quick, seen = renderer.render_rays(field, rays, ctx)
    colours = sum(count for count, want in asked if Quantity.RADIANCE in want)
    assert 0 < colours < 0.3 * len(trace.samples)
    assert all(want == Quantity.DENSITY or Quantity.DENSITY not in want for _, want in asked)
    bound = MAX_SKIPPED_WEIGHT + STOPPING.transmittance
    assert float((quick.rgb - whole.rgb).abs().max()) <= bound
    assert float((quick.alpha - whole.alpha).abs().max()) <= STOPPING.transmittance + 1e-5
    both = (quick.alpha > 0.6) & (whole.alpha > 0.6)
    assert bool(both.any())
    torch.testing.assert_close(quick.depth[both], whole.depth[both], atol=0.05, rtol=0)
    assert seen.values is not None
    assert seen.values.density is not None
    assert seen.samples is not None
    assert len(seen.values.density) == len(seen.samples)


def test_normals_are_asked_of_few_and_the_picture_stays(make_scene: Callable[..., Scene]) -> None:
    """Of a sampler that says nothing of the density too: one cheap look, then a normal only where it is seen."""
    scene, asked = make_scene(), []

    class Spy(Sphere):
        def query(self, samples: Samples, want: Quantity):
            asked.append((len(samples), want))
            return super().query(samples, want)

    field, renderer = Spy(60.0, 0.8), Volumetric(StratifiedConfig(64).build(scene))
    rays, ctx = scene.train[0].camera.rays(), Context(scene.bounds, training=False, geometry=True)
    whole, trace = renderer.render_rays(field, rays, ctx)
    asked.clear()
    with torch.no_grad():
        quick, _ = renderer.render_rays(field, rays, ctx)
    assert trace.samples is not None
    assert 0 < sum(count for count, want in asked if Quantity.NORMAL in want) < 0.3 * len(trace.samples)
    assert float((quick.rgb - whole.rgb).detach().abs().max()) <= MAX_SKIPPED_WEIGHT
    assert whole.normal is not None
    assert quick.normal is not None
    clear = whole.alpha > 0.6
    torch.testing.assert_close(quick.normal[clear], whole.normal[clear], atol=5e-3, rtol=0)


def test_gradients_reach_every_kept_sample(make_scene: Callable[..., Scene]) -> None:
    """Where gradients are wanted the field is asked in full: density found on the way has none.

    What is not kept has next to no weight, and so next to no gradient.
    """
    scene, gradients = make_scene(), []
    for config in (STOPPING, replace(STOPPING, stop="never")):
        field = Sphere(3.0, 0.8)
        rays = scene.train[0].camera.rays()
        rendering, trace = Volumetric(config.build(scene)).render_rays(field, rays, Context(scene.bounds))
        assert trace.values is not None
        assert trace.values.radiance is not None
        assert float(trace.values.radiance.detach().min()) > 0
        rendering.alpha.sum().backward()
        assert field.density.grad is not None
        gradients.append(float(field.density.grad))
    assert gradients[0] == pytest.approx(gradients[1], rel=0.02)
    assert gradients[1] > 0


@pytest.mark.parametrize("config", [STOPPING, StratifiedConfig(16)])
def test_a_picture_does_not_depend_on_how_it_is_cut(make_scene: Callable[..., Scene], config) -> None:
    scene, field = make_scene(), GaussianBlob(60.0, 0.04)
    camera, renderer, sizes = scene.train[0].camera, Volumetric(config.build(scene)), []

    whole, _ = renderer.render_rays(field, camera.rays(), Context(scene.bounds))
    original = renderer.render_rays
    renderer.render_rays = lambda f, rays, ctx: (sizes.append(len(rays)), original(f, rays, ctx))[1]  # type: ignore[method-assign]
    with torch.no_grad():
        parts, _ = renderer.render_image(field, camera, Context(scene.bounds, chunk=128))
    assert sum(sizes) == camera.width * camera.height
    assert len(sizes) > 1
    torch.testing.assert_close(parts.rgb.reshape(-1, 3), whole.rgb, atol=2 * MAX_SKIPPED_WEIGHT, rtol=0)


def test_parts_grow_where_rays_take_few_samples(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene()
    sampler = STOPPING.build(scene)
    sampler.occupied.zero_()
    renderer, sizes = Volumetric(sampler), []
    original = renderer.render_rays
    renderer.render_rays = lambda f, rays, ctx: (sizes.append(len(rays)), original(f, rays, ctx))[1]  # type: ignore[method-assign]
    renderer.render_image(Sphere(1.0, 0.5), scene.train[0].camera, Context(scene.bounds, chunk=64))
    assert sizes == [4, 8, 16, 32, 60]


def test_long_marches_go_on_behind_their_limit() -> None:
    """More intervals than one march keeps; still sorted, and without a gap."""
    bounds = Bounds(-torch.ones(3), torch.ones(3))
    sampler = OccupancyConfig(resolution=2, steps_per_diagonal=8192, stop="never").build(
        Scene("made up", (), (), torch.ones(3), bounds)
    )
    origins = torch.tensor([[-2.0, 0.1, 0.2], [0.3, -3.0, -0.4]])
    rays = bounds.clip(Rays.make(origins, torch.eye(3)[:2]))
    samples, _ = sampler.sample(rays, Sphere(1.0, 0.5), Context(bounds))
    for ray in range(2):
        own = samples[samples.ray == ray]
        assert len(own) > 4000
        torch.testing.assert_close(own.t1[:-1], own.t0[1:])
        assert float(own.t0[0]) == float(rays.near[ray])
        assert float(own.t1[-1]) == float(rays.far[ray])
    assert bool((samples.ray[1:] >= samples.ray[:-1]).all())


def test_features_found_on_the_way_spare_the_second_look(make_scene: Callable[..., Scene]) -> None:
    """A field that hands out features gives the same picture, and is asked about no position twice."""
    scene, asked = make_scene(), []
    field = NeuralFieldConfig(
        HashConfig(levels=3, log2_size=8, base=4, finest=16), layers=1, width=16, skip=-1, geometry_features=4, direction="sh",
        density_bias=2.0,
    ).build(scene)  # fmt: skip
    torch.nn.init.uniform_(field.encoding.table, -1, 1)  # type: ignore[attr-defined]
    rays, ctx, renderer = scene.train[0].camera.rays(), Context(scene.bounds), Volumetric(STOPPING.build(scene))
    encode = field.encoding.forward
    with torch.no_grad():
        whole, _ = Volumetric(replace(STOPPING, stop="never").build(scene)).render_rays(field, rays, ctx)
        field.encoding.forward = lambda unit, *rest: (asked.append(len(unit)), encode(unit, *rest))[1]  # type: ignore[method-assign]
        quick, trace = renderer.render_rays(field, rays, ctx)
    assert trace.samples is not None
    assert trace.samples.features is not None
    assert trace.samples.features.shape == (len(trace.samples), 4)
    march = sum(asked)
    assert len(trace.samples) <= march < 2 * len(trace.samples)
    assert float((quick.rgb - whole.rgb).abs().max()) <= MAX_SKIPPED_WEIGHT + STOPPING.transmittance
    again = field.query(trace.samples, Quantity.DENSITY | Quantity.FEATURES)
    torch.testing.assert_close(trace.samples.density, again.density)
    torch.testing.assert_close(trace.samples.features, again.features)
