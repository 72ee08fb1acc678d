"""The occupancy grid: what it forgets, when it looks, and that skipping and stopping leave the picture alone."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from made_up_fields import NOTHING, OfDensity
from torch import Tensor

from invgraphics.core import Context, Field, Quantity, Samples, Scene
from invgraphics.fields.analytic import GaussianBlob, Sphere
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.occupancy import OccupancyConfig, OccupancyGridSampler
from invgraphics.renderers.volumetric import Volumetric

SMALL = OccupancyConfig(resolution=16, steps_per_diagonal=256, warmup=32, every=4, cells=512)


def context(scene: Scene, training: bool = True) -> Context:
    return Context(scene.bounds, training=training, generator=torch.Generator().manual_seed(1))


def learnt(config: OccupancyConfig, scene: Scene, field: Field, updates: int = 33) -> OccupancyGridSampler:
    sampler, ctx = config.build(scene), context(scene)
    for _ in range(updates):
        sampler.update(field, ctx)
    return sampler


def test_starts_full_and_finds_the_ball(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(40.0, 0.6)
    sampler = SMALL.build(scene)
    assert bool(sampler.occupied.all())
    sampler = learnt(SMALL, scene, ball)
    centres = (torch.stack(torch.meshgrid(*[torch.arange(16)] * 3, indexing="ij"), dim=-1) + 0.5) / 16
    radius = scene.bounds.from_unit(centres).norm(dim=-1)
    cell = 3.0 / 16
    assert bool(sampler.occupied[radius < 0.6 - cell].all())
    assert not bool(sampler.occupied[radius > 0.6 + cell].any())
    assert int(sampler.step) == 33


def test_an_even_fog_stays(make_scene: Callable[..., Scene]) -> None:
    """A density below the threshold everywhere is all there is to see: the mean takes the threshold's place."""
    scene = make_scene()
    sampler = learnt(SMALL, scene, Sphere(0.1, 100.0))
    assert float(sampler.ema.max()) < SMALL.threshold
    assert bool(sampler.occupied.all())


@pytest.mark.parametrize("stop", ["always", "never"])
def test_picture_equals_the_one_without_a_grid(make_scene: Callable[..., Scene], stop: str) -> None:
    """Smooth, so that a cell whose random points are empty has little else in it."""
    scene, blob = make_scene(), GaussianBlob(30.0, 0.02, colour=(0.2, 0.5, 0.9))
    config = replace(SMALL, stop=stop, threshold=1e-5)
    rays, ctx = scene.train[0].camera.rays(), context(scene, training=False)
    full = Volumetric(OccupancyConfig(resolution=4, steps_per_diagonal=256, stop="never").build(scene))
    expected, everything = full.render_rays(blob, rays, ctx)
    got, kept = Volumetric(learnt(config, scene, blob)).render_rays(blob, rays, ctx)
    assert everything.samples is not None
    assert kept.samples is not None
    assert len(kept.samples) < 0.5 * len(everything.samples)
    assert float(expected.alpha.detach().max()) > 0.99
    torch.testing.assert_close(got.rgb, expected.rgb, atol=2 * config.transmittance, rtol=0)
    torch.testing.assert_close(got.alpha, expected.alpha, atol=2 * config.transmittance, rtol=0)


def in_front_of(values: Tensor, ray: Tensor) -> Tensor:
    """Per sample, the sum of the values of the same ray's nearer samples, one ray at a time."""
    parts = [own.cumsum(0) - own for own in (values[ray == r] for r in torch.unique(ray))]
    return torch.cat(parts)


def test_samples_behind_opaque_surfaces_are_left_out(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(200.0, 0.8)
    rays = scene.bounds.clip(scene.train[0].camera.rays())
    ctx = context(scene, training=False)
    density = ball.density_no_grad
    for chunk in (1, 7, 32):
        sampler = learnt(replace(SMALL, chunk=chunk, transmittance=0.01), scene, ball)
        samples, _ = sampler.sample(rays, ball, ctx)
        tau = density(samples) * samples.delta
        before = in_front_of(tau, samples.ray)
        assert bool((before <= -torch.log(torch.tensor(0.01)) + 1e-4).all())
        # The same as marching everything and cutting afterwards, whatever the chunk.
        whole, _ = learnt(replace(SMALL, stop="never"), scene, ball).sample(rays, ball, ctx)
        before = in_front_of(density(whole) * whole.delta, whole.ray)
        visible = before <= -torch.log(torch.tensor(0.01))
        assert len(samples) < 0.7 * len(whole)
        assert torch.equal(samples.ray, whole.ray[visible])
        torch.testing.assert_close(samples.t0, whole.t0[visible])


def test_stopping_in_evaluation_only(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(200.0, 0.8)
    rays, field = scene.bounds.clip(scene.train[0].camera.rays()), OfDensity(lambda s: ball.density_at(s.position))
    sampler = replace(SMALL, stop="evaluation").build(scene)
    sampler.sample(rays, field, context(scene, training=True))
    assert field.asked == []
    sampler.sample(rays, field, context(scene, training=False))
    assert sum(field.asked) > 0


def test_jitter_shifts_the_whole_lattice(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene()
    rays, sampler = scene.bounds.clip(scene.train[0].camera.rays()), replace(SMALL, stop="never").build(scene)
    still, _ = sampler.sample(rays, NOTHING, context(scene, training=False))
    moved, _ = sampler.sample(rays, NOTHING, context(scene))
    for ray in range(0, len(rays), 17):
        offset = moved.t0[moved.ray == ray][:20] - still.t0[still.ray == ray][:20]
        assert float(offset.std()) < 1e-5
        assert -1e-6 < float(offset[0]) < sampler.length


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_evaluation_may_take_finer_steps(make_scene: Callable[..., Scene], space: str) -> None:
    """Half the step, or at a distance half its growth; the training steps stay what they are."""
    scene = make_scene(space)
    rays, coarse = scene.bounds.clip(scene.train[0].camera.rays())[:20], replace(SMALL, stop="never")
    fine, ctx = replace(coarse, evaluation_steps=512), context(scene, training=False)
    long, short = (config.build(scene).sample(rays, NOTHING, ctx)[0] for config in (coarse, fine))
    assert len(short) == pytest.approx(2 * len(long), rel=0.02)
    assert float(short.delta[0]) == pytest.approx(float(long.delta[0]) / 2, rel=1e-5)
    ctx = [context(scene) for _ in range(2)]
    trained = [config.build(scene).sample(rays, NOTHING, c)[0] for config, c in zip((coarse, fine), ctx, strict=True)]
    assert torch.equal(trained[0].t0, trained[1].t0)


def test_training_may_begin_with_longer_steps(make_scene: Callable[..., Scene]) -> None:
    """A quarter of the steps at first, half of them by an eighth of the fit; and what a cell holds counts per step."""
    scene = make_scene()
    rays, config = scene.bounds.clip(scene.train[0].camera.rays())[:20], replace(SMALL, stop="never", early_steps=64)
    sampler, lengths = config.build(scene), []
    for progress in (0.0, 0.125, 0.25, 1.0):
        ctx = replace(context(scene), progress=progress)
        samples, _ = sampler.sample(rays, NOTHING, ctx)
        sampler.update(OfDensity(lambda samples: torch.ones(len(samples))), ctx)
        lengths.append(float(samples.delta[0]) / sampler.length)
        if progress == 0:
            assert float(sampler.ema.max()) == pytest.approx(4 * sampler.length, rel=1e-5)
    assert lengths == pytest.approx([4, 2, 1, 1], rel=1e-4)
    seen, _ = sampler.sample(rays, NOTHING, context(scene, training=False))
    assert float(seen.delta[0]) == pytest.approx(sampler.length, rel=1e-5)


def test_training_may_end_with_shorter_steps(make_scene: Callable[..., Scene]) -> None:
    """Four times the steps at the end, twice as many when three quarters are over; before the middle nothing is different."""
    scene = make_scene()
    rays, config = scene.bounds.clip(scene.train[0].camera.rays())[:20], replace(SMALL, stop="never", late_steps=1024)
    sampler, lengths = config.build(scene), []
    for progress in (0.0, 0.5, 0.75, 1.0):
        samples, _ = sampler.sample(rays, NOTHING, replace(context(scene), progress=progress))
        lengths.append(float(samples.delta[0]) / sampler.length)
    assert lengths == pytest.approx([1, 1, 1 / 2, 1 / 4], rel=1e-4)


def test_looks_on_schedule_at_as_many_cells_as_allowed(make_scene: Callable[..., Scene]) -> None:
    scene, fog = make_scene(), OfDensity(lambda samples: torch.ones(len(samples)))
    sampler, ctx = SMALL.build(scene), context(scene)
    for _ in range(48):
        sampler.update(fog, ctx)
    assert fog.asked == [16**3] * 8 + [512] * 4


def test_memory_fades_where_it_looked(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(40.0, 0.6)
    sampler, ctx = learnt(replace(SMALL, warmup=1000), scene, ball), context(scene)
    before = sampler.ema.clone()
    for _ in range(4 * 5):
        sampler.update(NOTHING, ctx)
    torch.testing.assert_close(sampler.ema, before * SMALL.decay**5)


def test_a_wire_is_kept_by_the_patience_of_a_late_fit(make_scene: Callable[..., Scene]) -> None:
    """A ball that fills a twenty-fifth of its cells: most random looks find nothing there."""
    scene, wire = make_scene(), Sphere(400.0, 0.08)  # a cell is 0.19 wide, and eight of them meet here
    config = replace(SMALL, warmup=10**6, decay=0.98, early_decay=0.5)
    sampler = config.build(scene)
    middle = slice(7, 9)
    kept = {}
    for progress in (0.0, 1.0):
        ctx, present = replace(context(scene), progress=progress), []
        for _ in range(400):
            sampler.update(wire, ctx)
            present.append(float(sampler.occupied[middle, middle, middle].float().mean()))
        kept[progress] = sum(present[200:]) / 200
    assert kept[0.0] < 0.6
    assert kept[1.0] > 0.85
    assert [round(config.decay_at(share), 3) for share in (0.0, 0.25, 0.5, 1.0)] == [0.5, 0.9, 0.98, 0.98]
    assert SMALL.decay_at(0.0) == SMALL.decay


def test_steps_grow_with_a_cone(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene("contracted")
    steps = SMALL.steps_per_diagonal / 4
    sampler = replace(SMALL, cone=1 / steps).build(scene)
    rays = scene.bounds.clip(scene.train[0].camera.rays())
    samples, _ = sampler.sample(rays, NOTHING, context(scene, training=False))
    first = samples[samples.ray == 0]
    assert float(first.t1[-1]) == pytest.approx(float(rays.far[0]))
    grown = first.t0 > steps * sampler.length
    torch.testing.assert_close(first.delta[grown][:-1], first.t0[grown][:-1] / steps, rtol=1e-3, atol=0)
    # An even fog is worth as much per step as it is long: far cells must not be forgotten.
    sampler = learnt(replace(SMALL, cone=1 / steps), scene, Sphere(0.05, 1e6))
    assert sampler.visible is not None
    axis = (torch.arange(16) + 0.5) / 16 - 0.5
    distance = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0).where(sampler.visible, 0.0)
    assert float(distance.max()) > 0.4  # of 0.5, where space ends
    assert float(sampler.ema.flatten()[distance.argmax()] / sampler.ema[8, 8, 8]) > 2


def test_rays_with_more_samples_than_one_march_takes(make_scene: Callable[..., Scene]) -> None:
    """Some rays go on after others have ended: each is still tiled without a gap."""
    scene = make_scene()
    sampler = replace(SMALL, steps_per_diagonal=2000, stop="never").build(scene)
    rays = scene.bounds.clip(scene.train[0].camera.rays())
    samples, _ = sampler.sample(rays, NOTHING, context(scene, training=False))
    counts = torch.bincount(samples.ray, minlength=len(rays))
    assert 0 < int((counts > 1024).sum()) < int((counts > 0).sum())
    lengths = torch.zeros(len(rays)).index_add(0, samples.ray, samples.delta)
    torch.testing.assert_close(lengths, rays.far - rays.near, rtol=1e-4, atol=1e-4)
    assert bool((samples.t0[1:] >= samples.t0[:-1])[samples.ray[1:] == samples.ray[:-1]].all())


def test_endless_space_takes_as_many_steps_as_its_contraction_is_long(make_scene: Callable[..., Scene]) -> None:
    """Each but the last, which is cut, is the same part of the way through the contracted ball, to first order."""
    scene = make_scene("contracted")
    sampler, rays = replace(SMALL, steps_per_diagonal=2048).build(scene), scene.bounds.clip(scene.train[0].camera.rays())
    samples, _ = sampler.sample(rays, NOTHING, context(scene, training=False))
    first = samples[(samples.ray == 0) & (samples.t1 < 20)]
    ends = [scene.bounds.to_unit(rays[:1].at(t[None])[0]) for t in (first.t0, first.t1)]
    moved = (ends[1] - ends[0]).norm(dim=1) * 4 * scene.bounds.half[0]
    torch.testing.assert_close(moved, torch.full_like(moved, sampler.length), rtol=0.05, atol=0)
    assert 100 < len(samples) / len(rays) < 4 * 2048 / 3**0.5 / 2


def test_nothing_is_culled_before_the_field_was_fitted_at_all(make_scene: Callable[..., Scene]) -> None:
    """In thin fog every cell is below the threshold; culled at once, none would ever be sampled again."""
    scene = make_scene()
    ctx = context(scene, training=True)
    sampler = replace(SMALL, grace=3, every=1).build(scene)
    for _ in range(3):
        sampler.update(NOTHING, ctx)
        assert bool(sampler.occupied.all())
        assert float(sampler.ema.max()) == 0
    thick = OfDensity(lambda samples: (samples.position[:, 0] > 0).float() * 100)
    sampler.update(thick, ctx)
    assert 0.3 < float(sampler.occupied.float().mean()) < 0.7


@pytest.mark.parametrize(("grace", "warmup"), [(0, 32), (32, 32), (40, 8), (100, 32), (16, 0)])
def test_no_cell_is_culled_that_was_never_looked_at(make_scene: Callable[..., Scene], grace: int, warmup: int) -> None:
    """The first refresh looks at all cells however late it comes, though later ones look at few."""
    scene, solid = make_scene(), Sphere(40.0, 0.9)
    sampler = replace(SMALL, grace=grace, warmup=warmup, every=16, cells=16).build(scene)
    for _ in range(grace + 17):
        sampler.update(solid, context(scene))
    centres = (torch.stack(torch.meshgrid(*[torch.arange(16)] * 3, indexing="ij"), dim=-1) + 0.5) / 16
    inside = scene.bounds.from_unit(centres).norm(dim=-1) < 0.9 - 3.0 / 16  # with all of their points
    assert bool(sampler.occupied[inside].all()) and not bool(sampler.occupied.all())


def test_the_long_preset_gives_up_nothing_as_thick_as_the_fog_it_starts_with(make_scene: Callable[..., Scene]) -> None:
    """A cable that few rays have met is no denser than the fog was when its surroundings are long clear or opaque."""
    scene, recipe = make_scene(), load_method("volumetric/hash", "long").recipe
    fog = math.exp(recipe.field.density_bias)
    sampler = recipe.renderer.sampler.build(scene)
    # The cable lies along z, in empty space; the ball makes the grid's mean large, so that it is not the threshold.
    ball, cable = Sphere(40.0, 0.6), lambda p: fog * ((p[:, :2] - 1.0).norm(dim=1) < 0.1)
    both = OfDensity(lambda samples: ball.density_at(samples.position) + cable(samples.position))
    for _ in range(sampler.config.grace + 2 * sampler.config.every + 1):
        sampler.update(both, context(scene))
    centres = (torch.stack(torch.meshgrid(*[torch.arange(64)] * 3, indexing="ij"), dim=-1) + 0.5) / 64
    position = scene.bounds.from_unit(centres).reshape(-1, 3)
    assert float(sampler.occupied.float().mean()) < 0.1
    assert bool(sampler.occupied.flatten()[(position[:, :2] - 1.0).norm(dim=1) < 0.05].all())


def test_an_untrained_grid_is_full_and_the_trained_one_stays(make_scene: Callable[..., Scene]) -> None:
    for space in ("box", "contracted"):
        scene = make_scene(space)
        sampler = learnt(SMALL, scene, Sphere(40.0, 0.6))
        few = int(sampler.occupied.sum())
        fresh = sampler.untrained()
        assert torch.equal(fresh.occupied, SMALL.build(scene).occupied)
        assert int(sampler.occupied.sum()) == few < int(fresh.occupied.sum())
        assert int(fresh.step) == 0
        assert not bool(fresh.ema.any())


def test_refusals() -> None:
    with pytest.raises(ValueError, match="early_decay"):
        OccupancyConfig(early_decay=1.0)
    with pytest.raises(ValueError, match="resolution must be at least 1"):
        OccupancyConfig(resolution=0)
    with pytest.raises(ValueError, match="transmittance"):
        OccupancyConfig(transmittance=1.0)


def test_fields_are_asked_for_density_only(make_scene: Callable[..., Scene]) -> None:
    scene, wanted = make_scene(), []

    class Spy(Sphere):
        def query(self, samples: Samples, want: Quantity):
            wanted.append(want)
            return super().query(samples, want)

    learnt(SMALL, scene, Spy(1.0, 1.0), updates=1)
    assert set(wanted) == {Quantity.DENSITY}
