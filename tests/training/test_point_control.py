"""Points that are doubted go, points come where rays end far from any, the optimiser follows, and a fit resumes bit by bit."""

import math

import pytest
import torch

from invgraphics.core import Context
from invgraphics.errors import InputError
from invgraphics.kernels.near import near_points
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.testing import toy_scene
from invgraphics.training.hooks import FitState
from invgraphics.training.points.control import ConfidencePenalty, PointControlConfig

SHRUNK = [
    "field.features=6",
    "field.width=16",
    "field.density_scale=10",
    "field.colour_width=16",
    "field.max_init=300",
    "renderer.sampler.resolution=24",
    "renderer.sampler.steps_per_diagonal=96",
    "renderer.sampler.grace=8",
    "batches.rays=128",
    "batches.samples=2048",
    "hooks.0.at=[0.3,0.6]",
    "hooks.0.rays=2048",
]


def psnr(fit) -> float:
    scene, errors = fit.plan.scene, []
    for view in scene.test:
        picture = fit.model.render(view.camera, normals=False)
        errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
    return -10 * math.log10(float(torch.stack(errors).mean()))


def state_of(fit) -> FitState:
    ctx = Context(fit.plan.scene.bounds, training=True, progress=0.5, generator=torch.Generator().manual_seed(0))
    return FitState(fit.model.field, fit.model.renderer, fit._optimiser, fit.plan.scene, ctx, 1)


@pytest.fixture(scope="module")
def small_scene():
    return toy_scene(views=6, size=16)


def test_learns_the_toy_scene(small_scene, make_fit) -> None:
    fit = make_fit("volumetric/point-nerf", small_scene, 80, 0, *SHRUNK, "field.width=32", "field.reach=1.0")
    losses = []
    before = psnr(fit)
    fit.run(lambda loss: bool(losses.append(loss)))
    # Six pictures of 16 x 16 pixels: little is learnt of new views, much of these.
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    assert psnr(fit) > before + 1


def test_resumed_equals_uninterrupted(small_scene, make_fit, tmp_path) -> None:
    whole, first, second = (make_fit("volumetric/point-nerf", small_scene, 24, 0, *SHRUNK) for _ in range(3))
    whole.run(lambda loss: False)
    first.run(lambda loss: first.steps == 13)
    checkpoint.save(tmp_path / CHECKPOINT, first.state())
    torch.manual_seed(99)
    second.load(checkpoint.load(tmp_path / CHECKPOINT), seconds=1.0)
    second.run(lambda loss: False)
    one, other = whole.state(), second.state()
    assert all(torch.equal(one[part][key], other[part][key]) for part in one for key in one[part])


def test_prunes_doubted_points_and_keeps_the_others_moments(small_scene, make_fit) -> None:
    fit = make_fit("volumetric/point-nerf", small_scene, 10, 0, *SHRUNK)
    fit.run(lambda loss: fit.steps == 3)
    field = fit.model.field
    with torch.no_grad():
        field.confidence_logits[::2] = -5.0
    kept = field.positions[1::2].clone()
    moments = {key: value.clone() for key, value in fit._optimiser.state().items() if "field.features" in key}
    PointControlConfig(at=(0.5,), max_growth=0.0).build().act(state_of(fit), 1)
    assert torch.equal(field.positions, kept)
    assert len(field.features) == len(field.raw_rgb) == len(field.confidence_logits) == len(kept)
    after = {key: value for key, value in fit._optimiser.state().items() if "field.features" in key}
    for key, value in moments.items():
        assert torch.equal(after[key], value[1::2] if value.ndim else value)
    fit.step()  # the optimiser holds the new parameters


def test_grows_where_rays_end_far_from_points(small_scene, make_fit) -> None:
    fit = make_fit("volumetric/point-nerf", small_scene, 10, 0, *SHRUNK)
    field = fit.model.field
    # A hole: no points on one side of the balls. What is left is made opaque, and its density reaches into the hole.
    rows = field.positions[:, 1] < 0.1
    field.replace(
        {name: getattr(field, name)[rows].clone() for name in ("positions", "features", "raw_rgb", "confidence_logits")}
    )
    with torch.no_grad():
        field.confidence_logits.fill_(4.0)
        field.density_head.bias.fill_(6.0)
    for name in ("features", "raw_rgb", "confidence_logits"):
        keep = torch.arange(len(field.positions))
        fit._optimiser.reindex_rows(f"field.{name}", getattr(field, name), keep, 0)
    before = field.positions.clone()
    config = PointControlConfig(at=(0.5,), rays=2000, distance=0.3, max_growth=0.1)
    config.build().act(state_of(fit), 1)
    new = field.positions[len(before) :]
    assert 5 < len(new) <= 0.1 * len(before)
    apart = 0.3 * float(field.radius)
    _, squared = near_points(new, before, 1, 10.0)
    assert float(squared.sqrt().min()) >= apart * (1 - 1e-5)
    assert float(squared.sqrt().max()) <= float(field.radius) * (1 + 1e-5)
    cells = (new / apart).floor()
    assert len(torch.unique(cells, dim=0)) == len(new)
    # Their features are means of their neighbours'.
    span = field.raw_rgb[: len(before)]
    assert bool((field.raw_rgb[len(before) :] <= span.amax(dim=0)).all())
    assert bool((field.raw_rgb[len(before) :] >= span.amin(dim=0)).all())


def test_confidence_penalty_is_least_at_zero_and_one(small_scene, make_fit) -> None:
    field = make_fit("volumetric/point-nerf", small_scene, 10, 0, *SHRUNK).model.field
    ctx, penalty = Context(small_scene.bounds), ConfidencePenalty(weight=2.0)
    value = float(penalty(field, None, ctx).detach())
    assert value == pytest.approx(2 * (math.log(0.15) + math.log(0.85)), rel=1e-4)
    with torch.no_grad():
        field.confidence_logits.fill_(0.0)
    assert float(penalty(field, None, ctx).detach()) > value


def test_growth_of_what_is_not_seen_along_rays_is_refused_before_the_first_step(small_scene, make_fit) -> None:
    plan = make_fit("volumetric/point-nerf", small_scene, 10, 0, *SHRUNK).plan
    plan.hooks[0].check_fit(plan.model.field, plan.model.renderer)
    with pytest.raises(InputError, match="The hook 'point_control' needs a renderer of rays"):
        plan.hooks[0].check_fit(plan.model.field, SplattingConfig().build(small_scene))
