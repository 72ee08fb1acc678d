"""Stratified and hierarchical sampling: tiling, spacing, and drawing from a histogram."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from made_up_fields import NOTHING

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Quantity, Rays, Samples, Scene
from invgraphics.errors import NotComposableError
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.samplers import (
    HierarchicalConfig,
    HierarchicalSampler,
    StratifiedConfig,
    from_spacing,
    sample_pdf,
    to_spacing,
)


def context(scene: Scene, training: bool = False) -> Context:
    return Context(scene.bounds, training=training, generator=torch.Generator().manual_seed(3))


def clipped(scene: Scene) -> Rays:
    """The view's rays and one that misses the box."""
    rays = scene.train[0].camera.rays()
    away = Rays.make(torch.tensor([[0.0, -9.0, 0.0]]), torch.tensor([[0.0, -1.0, 0.0]]))
    both = Rays(**{name: torch.cat([getattr(rays, name), getattr(away, name)]) for name in vars(rays)})
    return scene.bounds.clip(both)


def assert_tiles(samples: Samples, rays: Rays, per_ray: int) -> None:
    """The intervals of each ray that hits follow on one another from near to far; the others have none."""
    hit = torch.nonzero(rays.far > rays.near)[:, 0]
    assert samples.ray.tolist() == hit.repeat_interleave(per_ray).tolist()
    t0, t1 = samples.t0.view(-1, per_ray), samples.t1.view(-1, per_ray)
    torch.testing.assert_close(t0[:, 0], rays.near[hit])
    torch.testing.assert_close(t1[:, -1], rays.far[hit], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(t0[:, 1:], t1[:, :-1])
    assert bool((t1 >= t0).all())


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("space", ["box", "contracted"])
def test_intervals_tile_the_ray(make_scene: Callable[..., Scene], space: str, training: bool) -> None:
    scene = make_scene(space)
    rays, ctx = clipped(scene), context(scene, training)
    samples, levels = StratifiedConfig(20).build(scene).sample(rays, NOTHING, ctx)
    assert_tiles(samples, rays, 20)
    assert levels == ()
    fine, levels = HierarchicalConfig(12, 7).build(scene).sample(rays, NOTHING, ctx)
    assert_tiles(fine, rays, 19)
    # The coarse pass learns nothing, so that losses in training do not see it.
    assert [len(level.samples) for level in levels] == ([] if training else [12 * len(torch.unique(fine.ray))])


def test_jitter_only_in_training_and_only_from_the_generator(make_scene: Callable[..., Scene]) -> None:
    scene, sampler = make_scene(), StratifiedConfig(8).build(make_scene())
    rays = clipped(scene)
    still = [sampler.sample(rays, NOTHING, context(scene))[0].t0 for _ in range(2)]
    assert torch.equal(*still)
    jittered = [sampler.sample(rays, NOTHING, context(scene, training=True))[0].t0 for _ in range(2)]
    assert torch.equal(*jittered)
    shift = (jittered[0] - still[0]).view(-1, 8) / ((rays.far - rays.near)[rays.far > rays.near] / 8)[:, None]
    assert float(shift.abs().max()) <= 0.5 + 1e-4
    assert abs(float(shift[:, 1:].mean())) < 0.05
    assert float(shift[:, 1:].std()) == pytest.approx(12**-0.5, rel=0.1)


def test_contracted_spacing_is_linear_then_disparity(make_scene: Callable[..., Scene]) -> None:
    bounds: Bounds = make_scene("contracted").bounds
    t = torch.tensor([0.0, 0.5, 1.0, 2.0, 4.0, 1000.0]) * bounds.radius
    torch.testing.assert_close(to_spacing(t, bounds), torch.tensor([0, 0.25, 0.5, 0.75, 0.875, 0.9995]))
    torch.testing.assert_close(from_spacing(to_spacing(t, bounds), bounds), t, rtol=1e-4, atol=1e-6)
    box = make_scene("box").bounds
    assert torch.equal(to_spacing(t, box), t)


def test_inverting_a_histogram_equals_numpy() -> None:
    edges = torch.cumsum(torch.rand(5, 9) + 0.1, dim=1).double()
    mass, u = torch.rand(5, 8).double() + 1e-5, torch.rand(5, 30).double()
    got = sample_pdf(edges, mass, u)
    for row in range(5):
        cumulative = np.concatenate([[0], np.cumsum(mass[row].numpy())]) / mass[row].sum().item()
        np.testing.assert_allclose(got[row].numpy(), np.interp(u[row].numpy(), cumulative, edges[row].numpy()))


@pytest.mark.parametrize("training", [False, True])
def test_fine_samples_gather_where_the_density_is(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera], training: bool
) -> None:
    scene, ball = make_scene(), Sphere(50.0, 0.3)
    ray = scene.bounds.clip(make_camera().to(torch.float32).rays(torch.tensor([[6.4, 4.7]])))

    samples, _ = HierarchicalConfig(32, 64).build(scene).sample(ray, ball, context(scene, training))
    entry = float((ray.origins.norm(dim=1) - 0.3)[0])
    near_entry = (samples.mid - entry).abs() < 0.25
    # Uniform sampling would put a sixth of the 96 there.
    assert int(near_entry.sum()) > 60


class Dark(Field):
    """Radiance without density."""

    provides = Quantity.RADIANCE

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        return FieldValues(radiance=torch.zeros(len(samples), 3))


def test_own_proposal_leaves_a_trainable_level(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(5.0, 0.8, colour=(0.2, 0.5, 0.7))
    rays = clipped(scene)
    samples, levels = HierarchicalSampler(HierarchicalConfig(16, 16), ball).sample(rays, NOTHING, context(scene))
    (level,) = levels
    assert level.rays == len(rays)
    assert level.weights is not None
    assert level.values is not None
    assert level.values.radiance is not None
    assert level.samples is not None
    assert_tiles(level.samples, rays, 16)
    assert not samples.t0.requires_grad
    level.weights.sum().backward()
    assert ball.density.grad is not None
    assert float(ball.density.grad) > 0


def test_the_density_itself_stands_in_for_a_proposal(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(5.0, 0.8)
    taught = HierarchicalSampler(HierarchicalConfig(16, 16), Sphere(1.0, 0.1))
    plain = HierarchicalConfig(16, 16).build(scene)
    rays = clipped(scene)
    found, expected = (each.sample(rays, ball, context(scene))[0] for each in (taught.untrained(), plain))
    assert torch.equal(found.t0, expected.t0)
    assert plain.untrained() is plain


def test_refusals() -> None:
    with pytest.raises(ValueError, match="count"):
        StratifiedConfig(0)
    with pytest.raises(ValueError, match="coarse must be from 1"):
        HierarchicalConfig(coarse=0)
    with pytest.raises(NotComposableError, match="needs density, which Dark"):
        HierarchicalSampler(HierarchicalConfig(), Dark())
