"""Sphere tracing: each recipe, shrunk, learns a toy scene from pictures and masks, and resumes bit by bit; the mask loss."""

import pytest
import torch
from torch.nn.functional import binary_cross_entropy
from training_fixtures import Learnt, learn, resume, same_state, toy_scores

from invgraphics.core import Batch, Bounds, Context, Rendering, SurfaceTrace, Trace
from invgraphics.training.fit import Fit
from invgraphics.training.losses import MaskLoss

GRIDS = [f"field.{part}.{key}" for part in ("encoding", "appearance") for key in ("levels=4", "log2_size=12", "finest=32")]
SHRUNK = {
    "sphere-tracing/hash": [*GRIDS, "renderer.final_sharpness=60", "batches.rays=256"],
    "sphere-tracing/mlp": ["field.width=32", "renderer.final_sharpness=60", "batches.rays=256"],
}
STEPS = 200


@pytest.fixture(scope="module", params=SHRUNK)
def learnt(request: pytest.FixtureRequest, scene, make_fit, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    torch.manual_seed(0)
    fit = _fit(request.param, scene, make_fit)
    return learn(request.param, fit, STEPS, tmp_path_factory.mktemp("fits"))


def _fit(name: str, scene, make_fit) -> Fit:
    return make_fit(name, scene, STEPS, 0, *SHRUNK[name])


def test_finds_two_balls_from_pictures_and_masks(learnt: Learnt) -> None:
    """From one sphere, which has to part in two."""
    after = toy_scores(learnt.fit)
    assert after.psnr > max(learnt.before.psnr + 5, 18)
    assert after.depth < 0.12
    assert after.overlap > 0.85


def test_resumed_equals_uninterrupted(learnt: Learnt, scene, make_fit) -> None:
    assert same_state(resume(_fit(learnt.name, scene, make_fit), learnt.checkpoint), learnt.final)


def masked(logit: torch.Tensor, true: torch.Tensor, sharpness: float | None) -> torch.Tensor:
    """Mask loss of weight 2, in a box of half-extent 1.5."""
    n = len(logit)
    alpha, flags = logit.sigmoid(), torch.zeros(n, dtype=torch.bool)
    surface = None if sharpness is None else SurfaceTrace(logit, sharpness, flags, flags.long(), flags)
    batch = Batch(torch.zeros(n, 3), true, torch.zeros(3))
    ctx = Context(Bounds(torch.full((3,), -1.5), torch.full((3,), 1.5)))
    rendering = Rendering(torch.zeros(n, 3), alpha, torch.ones(n))
    return MaskLoss(2.0)(rendering, Trace(rays=n, surface=surface), batch, ctx)


def test_mask_loss_is_the_cross_entropy_over_the_sharpness() -> None:
    logit, true = torch.tensor([-2.0, 0.3, 3.0, 1.0]), torch.tensor([0.0, 1.0, 0.25, 0.0])
    plain = binary_cross_entropy(logit.double().sigmoid(), true.double())
    torch.testing.assert_close(masked(logit, true, None).double(), 2 * plain, rtol=1e-5, atol=0)
    torch.testing.assert_close(masked(logit, true, 40.0).double(), 2 * plain / 60, rtol=1e-5, atol=0)


def test_mask_loss_calls_back_what_is_nearly_gone() -> None:
    """An opacity of 4.5e-5 still has the slope -1 / opacity, where NeuS's cut at 1e-3 leaves none."""
    logit = torch.tensor([-10.0, -3.0], requires_grad=True)
    masked(logit, torch.tensor([1.0, 0.0]), None).backward()
    assert logit.grad is not None
    # d/dx -log(sigmoid(x)) = sigmoid(x) - 1, and d/dx -log(1 - sigmoid(x)) = sigmoid(x); mean of two, times the weight of two.
    torch.testing.assert_close(
        logit.grad, torch.stack([logit[0].sigmoid() - 1, logit[1].sigmoid()]).detach(), rtol=1e-2, atol=0
    )


@pytest.mark.parametrize("sharpness", [None, 50.0])
def test_mask_loss_of_opaque_photographs_is_nothing(sharpness: float | None) -> None:
    assert masked(torch.tensor([-2.0, 3.0]), torch.ones(2), sharpness) == 0
    assert masked(torch.tensor([-2.0, 3.0]), torch.tensor([1.0, 0.5]), sharpness) > 0


def test_mask_loss_pulls_on_saturated_rays_and_leaves_those_outside_the_bounds_alone() -> None:
    distance = torch.tensor([0.9, -0.9, 0.9, torch.inf], requires_grad=True)
    true = torch.tensor([1.0, 0.0, 0.0, 1.0])
    for sharpness in (50.0, 1600.0):
        loss = masked(-sharpness * distance, true, sharpness)
        (gradient,) = torch.autograd.grad(loss, distance)
        # Wrong by a whole sigmoid: the slope is the weight over half-extent and number of rays, whatever the sharpness.
        torch.testing.assert_close(gradient[:3], torch.tensor([1.0, -1.0, 0.0]) * 2 / (1.5 * 4), atol=1e-6, rtol=1e-5)
        assert float(gradient[3]) == 0
