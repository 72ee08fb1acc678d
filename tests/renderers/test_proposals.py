"""Proposal sampling: histograms widened and drawn from, levels with and without fields of their own, and their loss."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from made_up_fields import NOTHING
from torch import Tensor

from invgraphics.config import fill
from invgraphics.core import Batch, Context, Rays, Rendering, Samples, Scene, Trace
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.analytic import Sphere
from invgraphics.fields.density_field import DensityFieldConfig
from invgraphics.renderers.histograms import blur, dilate, resample
from invgraphics.renderers.proposals import ProposalSampler, ProposalsConfig
from invgraphics.renderers.volumetric import Volumetric
from invgraphics.training.interlevel import InterlevelLoss, outer_measure


def context(scene: Scene, training: bool = False, progress: float = 1.0) -> Context:
    return Context(scene.bounds, training=training, progress=progress, generator=torch.Generator().manual_seed(3))


def histogram(rows: int, bins: int) -> tuple[Tensor, Tensor]:
    steps = torch.rand(rows, bins + 1, dtype=torch.float64) + 0.05
    return steps.cumsum(dim=1), torch.rand(rows, bins, dtype=torch.float64)


@pytest.mark.parametrize("by", [0.01, 0.4, 100.0])
def test_dilation_takes_the_largest_density_within_reach(by: float) -> None:
    edges, weights = histogram(3, 7)
    wide, mass = dilate(edges, weights, by)
    torch.testing.assert_close(mass.sum(dim=1), weights.sum(dim=1))
    for row in range(3):
        e, density = edges[row], weights[row] / edges[row].diff()
        found = mass[row] / wide[row].diff().clamp_min(1e-300)
        factors = []
        for index in range(len(found)):
            x = float(wide[row, index] + wide[row, index + 1]) / 2
            if float(wide[row, index + 1] - wide[row, index]) > 1e-9:
                near = [float(density[k]) for k in range(7) if float(e[k]) - by < x < float(e[k + 1]) + by]
                factors.append(float(found[index]) / max(near))
        assert factors == pytest.approx([factors[0]] * len(factors), rel=1e-6)


def test_no_dilation_changes_no_density() -> None:
    edges, weights = histogram(3, 7)
    wide, mass = dilate(edges, weights, 0.0)
    for row in range(3):
        where = torch.searchsorted(edges[row], (wide[row, 1:] + wide[row, :-1]) / 2) - 1
        summed = torch.zeros(7, dtype=torch.float64).index_add_(0, where.clamp(0, 6), mass[row])
        torch.testing.assert_close(summed, weights[row])


def test_blur_is_the_mean_of_neighbouring_maxima() -> None:
    _, weights = histogram(2, 5)
    for row, found in zip(weights.tolist(), blur(weights).tolist(), strict=True):
        padded = [row[0], *row, row[-1]]
        expected = [(max(padded[i : i + 2]) + max(padded[i + 1 : i + 3])) / 2 for i in range(5)]
        assert found == pytest.approx(expected)


def test_intervals_lie_around_points_of_equal_mass(make_scene: Callable[..., Scene]) -> None:
    edges = torch.tensor([[0.0, 0.5, 1.0]], dtype=torch.float64)
    mass = torch.tensor([[3.0, 1.0]], dtype=torch.float64)
    found = resample(edges, mass, 4, context(make_scene()), per_ray=True)
    # Quantiles 1/8, 3/8, 5/8 and 7/8 are at 1/12, 1/4, 5/12 and 3/4.
    torch.testing.assert_close(found, torch.tensor([[0, 1 / 6, 1 / 3, 7 / 12, 11 / 12]], dtype=torch.float64))
    moved = [
        resample(edges, torch.ones(1, 2).double(), 8, context(make_scene(), training=True), per_ray=one)
        for one in (True, False)
    ]
    together, apart = ((each[0, 1:-1] * 8).diff() for each in moved)
    torch.testing.assert_close(together, torch.ones_like(together))
    assert float((apart - 1).abs().max()) > 0.1


def rays_of(scene: Scene) -> Rays:
    away = Rays.make(torch.tensor([[0.0, -9.0, 0.0]]), torch.tensor([[0.0, -1.0, 0.0]]))
    return scene.bounds.clip(Rays.cat([scene.train[0].camera.rays()[::5], away]))


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_samples_gather_where_the_proposals_have_weight(make_scene: Callable[..., Scene], space: str) -> None:
    scene, proposal = make_scene(space), Sphere(40.0, 0.3)
    config = ProposalsConfig(counts=(32, 32), count=16, dilation=0.0, dilation_bias=0.0)
    sampler = ProposalSampler(replace(config, fields=(None, None)), [proposal, proposal])
    rays = scene.bounds.clip(scene.train[0].camera.rays())
    closest = rays.origins - (rays.origins * rays.directions).sum(dim=1, keepdim=True) * rays.directions
    hit = torch.nonzero(closest.norm(dim=1) < 0.2)[:, 0]
    assert len(hit) > 0

    def inside(progress: float) -> float:
        samples, levels = sampler.sample(rays, NOTHING, context(scene, True, progress))
        assert [len(level.samples or ()) // len(samples.ray.unique()) for level in levels] == [32, 32]
        assert bool((samples.t0[1:] >= samples.t1[:-1] - 1e-5)[samples.ray[1:] == samples.ray[:-1]].all())
        struck = torch.isin(samples.ray, hit)
        return float((samples.position[struck].norm(dim=1) < 0.35).float().mean())

    # Annealing (s = 10) begins with even samples and has all but ended halfway.
    assert inside(0.0) < 0.25
    assert inside(1.0) > 0.6
    assert config.exponent(0.5) == pytest.approx(10 * 0.5 / 5.5)


@pytest.mark.parametrize("settings", [{"dilation": 0.0, "dilation_bias": 0.1}, {"dilation": 3.2, "dilation_bias": 0.0}])
def test_samples_reach_as_far_beyond_a_thin_thing_as_weights_are_widened(
    make_scene: Callable[..., Scene], settings: dict[str, float]
) -> None:
    """All weight is in the small ball's intervals: without widening no sample is farther from it than one of them."""
    scene, proposal = make_scene(), Sphere(200.0, 0.05)
    rays = scene.bounds.clip(Rays.make(torch.tensor([[0.0, -4.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])))
    length = float(rays.far - rays.near)
    plain = ProposalsConfig(counts=(32,), count=64, fields=(None,), dilation=0.0, dilation_bias=0.0, padding=1e-9)

    def reach(config: ProposalsConfig) -> float:
        samples, _ = ProposalSampler(config, [proposal]).sample(rays, NOTHING, context(scene))
        return float((samples.position.norm(dim=1) / length).max())

    # Either setting widens by a tenth of the ray: 3.2 over the 32 intervals.
    assert reach(plain) < 0.07
    assert 0.09 < reach(replace(plain, **settings)) < 0.2
    # The filter of mip-NeRF spreads weights to one neighbour on each side.
    assert reach(plain) + 0.6 / 32 < reach(replace(plain, blurred=True)) < reach(plain) + 1.6 / 32


def test_proposals_learn_from_the_loss_alone_and_nothing_else_does(make_scene: Callable[..., Scene]) -> None:
    scene, proposal, ball = make_scene(), Sphere(0.2, 0.8), Sphere(9.0, 0.5, colour=(0.2, 0.5, 0.7))
    sampler = ProposalSampler(ProposalsConfig(counts=(16,), count=12, fields=(None,)), [proposal])
    rays = rays_of(scene)
    rays = replace(rays, origins=rays.origins.requires_grad_())
    rendering, trace = Volumetric(sampler).render_rays(ball, rays, context(scene, True))
    loss = InterlevelLoss()(rendering, trace, batch(len(rays)), context(scene, True))
    assert float(loss.detach()) > 0
    loss.backward()
    assert proposal.density.grad is not None
    assert float(proposal.density.grad) < 0  # more density makes more room
    assert ball.density.grad is None
    assert rays.origins.grad is None


def test_levels_of_the_rendered_field_are_hidden_unless_they_are_trained(make_scene: Callable[..., Scene]) -> None:
    scene, ball = make_scene(), Sphere(5.0, 0.8, colour=(0.2, 0.5, 0.7))
    shy = ProposalsConfig(counts=(8,), count=8)
    rays = rays_of(scene)
    assert ProposalSampler(shy, []).sample(rays, ball, context(scene, True))[1] == ()
    (level,) = ProposalSampler(replace(shy, train_levels=True), []).sample(rays, ball, context(scene, True))[1]
    assert level.values is not None
    assert level.values.radiance is not None
    assert level.weights is not None
    assert level.weights.requires_grad
    taught = ProposalSampler(replace(shy, fields=(None,)), [Sphere(1.0, 0.1)])
    found, expected = (each.sample(rays, ball, context(scene))[0] for each in (taught.untrained(), ProposalSampler(shy, [])))
    assert torch.equal(found.t0, expected.t0)


def batch(rays: int) -> Batch:
    return Batch(torch.zeros(rays, 3), torch.ones(rays), torch.zeros(3))


def trace_of(edges: Tensor, weights: Tensor, levels: tuple[Trace, ...] = ()) -> Trace:
    rows, bins = weights.shape
    ray = torch.arange(rows).repeat_interleave(bins)
    rays = Rays.make(
        torch.zeros(rows, 3, dtype=edges.dtype), torch.eye(3, dtype=edges.dtype)[torch.zeros(rows, dtype=torch.int64)]
    )
    samples = Samples.on(rays, ray, edges[:, :-1].flatten(), edges[:, 1:].flatten())
    return Trace(samples, None, weights.flatten(), levels, rays=rows)


def interlevel(trace: Trace) -> Tensor:
    nothing = Rendering(torch.zeros(3, 3), torch.zeros(3), torch.zeros(3))
    return InterlevelLoss()(nothing, trace, batch(3), Context(None))  # pyright: ignore[reportArgumentType]


def test_the_interlevel_loss_is_a_double_loop() -> None:
    (fine, w), (coarse, v) = histogram(3, 9), histogram(3, 5)
    coarse = coarse * 1.3 - 1.0
    v.requires_grad_()
    found = interlevel(trace_of(fine, w, (trace_of(coarse, v),)))
    expected = torch.zeros((), dtype=torch.float64)
    for row in range(3):
        for i in range(9):
            room = torch.zeros((), dtype=torch.float64)
            for j in range(5):
                if coarse[row, j] < fine[row, i + 1] and coarse[row, j + 1] > fine[row, i]:
                    room = room + v[row, j]
            excess = (w[row, i] - room).clamp_min(0)
            expected = expected + excess**2 / (w[row, i] + torch.finfo(torch.float32).eps) / 27
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)
    assert float(found.detach()) > 0.01
    gradients = [torch.autograd.grad(loss, v, retain_graph=True)[0] for loss in (found, expected)]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-8)


def test_the_interlevel_loss_is_exactly_zero_where_the_envelope_holds() -> None:
    edges, weights = (x.float() for x in histogram(3, 200))
    weights = weights / weights.sum(dim=1, keepdim=True)
    taught = weights.clone().requires_grad_()
    merged = trace_of(edges[:, ::4], taught.view(3, 50, 4).sum(dim=2))
    for level in (trace_of(edges, taught), merged):
        assert float(interlevel(trace_of(edges, weights, (level,))).detach()) == 0
    assert float(interlevel(trace_of(edges, 1.01 * weights, (trace_of(edges, taught),))).detach()) > 0
    # Touching ends are no overlap.
    t = torch.tensor([[0.0], [1.0], [2.0]])
    room = outer_measure(t[1:2], t[2:3], t[:2].T, t[1:].T, torch.tensor([[5.0, 7.0]]))
    assert float(room) == 7


def test_refusals() -> None:
    for bad, words in (
        ({"counts": []}, "at least"),
        ({"counts": [8, 8, 8], "fields": [{"type": "density"}] * 2}, "one for each of the 3 counts"),
        ({"anneal_until": 0.0}, "anneal_until"),
        ({"counts": [8], "fields": [{"type": "density"}], "train_levels": True}, "without fields of their own"),
        ({"blurred": True}, "either blurred or dilated"),
        ({"padding": 0.0}, "padding"),
    ):
        with pytest.raises(InputError, match=words):
            fill(ProposalsConfig, bad)
    with pytest.raises(NotComposableError, match="needs density"):
        ProposalSampler(ProposalsConfig(counts=(8,), fields=(None,)), [_blind()])


def _blind() -> Sphere:
    field = Sphere(1.0, 0.1)
    field.provides = field.provides & ~field.provides
    return field


def test_weights_may_be_annealed_for_a_part_of_the_fit_only() -> None:
    """Nerfacto: the exponent of its ``bias`` reaches 1 after 1,000 of 30,000 steps."""
    config = ProposalsConfig(anneal_until=1000 / 30000)
    assert config.exponent(1000 / 30000) == pytest.approx(1.0) and config.exponent(0.5) == 1.0
    assert config.exponent(100 / 30000) == pytest.approx(10 * 0.1 / (9 * 0.1 + 1))


def test_one_proposal_network_may_serve_all_levels(make_scene: Callable[..., Scene]) -> None:
    """As two with the same parameters: the same samples, and the sum of their gradients."""
    scene = make_scene()
    one = ProposalsConfig(counts=(8, 8), count=4, fields=(DensityFieldConfig(),)).build(scene)
    two = ProposalsConfig(counts=(8, 8), count=4, fields=(DensityFieldConfig(), DensityFieldConfig())).build(scene)
    for field in two.fields:
        field.load_state_dict(one.fields[0].state_dict())
    levels = []
    for sampler in (one, two):
        _, traces = sampler.sample(rays_of(scene), Sphere(5.0, 0.5), context(scene, True, 0.5))
        sum((trace.weights.square().sum() for trace in traces), torch.zeros(())).backward()
        levels.append(traces)
    for a, b in zip(*levels, strict=True):
        assert torch.equal(a.weights, b.weights)
    pairs = zip(*(field.parameters() for field in two.fields), strict=True)
    for shared, (first, second) in zip(one.fields[0].parameters(), pairs, strict=True):
        if shared.grad is not None:
            torch.testing.assert_close(shared.grad, first.grad + second.grad)


def test_no_sample_is_drawn_from_an_interval_without_length(make_scene: Callable[..., Scene]) -> None:
    """Dilation leaves some at both ends of a ray. At the start of a fit, when all weights count alike, they count nothing."""
    scene = make_scene()
    sampler = ProposalsConfig(counts=(64,), count=512, fields=(DensityFieldConfig(),)).build(scene)
    samples, _ = sampler.sample(rays_of(scene), Sphere(5.0, 0.5), context(scene, True, 0.0))
    assert float((samples.t1 - samples.t0).min()) > 0
