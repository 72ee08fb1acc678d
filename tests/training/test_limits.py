"""Gaussians that no gradient could change: one of each kind is made, and a step or two of a fit must bring it back."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from test_density_control import _scene

from invgraphics.core import Model, harmonics
from invgraphics.core.camera import pixel_sizes
from invgraphics.fields.gaussian import PARAMETERS, GaussianField
from invgraphics.kernels.dispatch import using
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.limits import COLLAPSED, LimitsConfig, dead_gaussians
from invgraphics.training.losses import PhotometricLoss
from invgraphics.training.optimiser import GroupConfig, OptimiserConfig
from invgraphics.training.rows import replace_rows


def _fit(colour: float, target: int, hooks: tuple = (LimitsConfig(),), **changes: float) -> Fit:
    """A fit of one Gaussian in front of grey, whose photographs are of one brightness (0 to 255)."""
    scene = _scene()
    image = torch.full((32, 32, 3), target, dtype=torch.uint8)
    views = tuple(replace(view, image=image) for view in scene.train)
    scene = replace(scene, train=views, background=torch.full((3,), 0.5))
    tensors = {
        "means": torch.zeros(1, 3),
        "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "log_scales": torch.full((1, 3), changes.get("log_scale", math.log(0.3))),
        "opacity_logits": torch.full((1,), changes.get("logit", 0.0)),
        "sh_dc": torch.full((1, 1, 3), (colour - 0.5) / harmonics.BAND_0),
        "sh_rest": torch.zeros(1, 0, 3),
    }
    groups = OptimiserConfig({"field": GroupConfig("field", 0.05)}, eps=1e-15)
    built = [hook.build() for hook in hooks]
    field = GaussianField(tensors)
    losses = [PhotometricLoss(distance="l1")]
    model = Model(field, SplattingConfig().build(scene), scene.bounds)
    return Fit(Plan(model, scene, losses, built, groups, BatchConfig(), Budget(steps=100)))


@pytest.fixture(params=["reference", "numba"], autouse=True)
def implementation(request):
    with using(request.param):
        yield


def test_a_black_gaussian_becomes_bright_again() -> None:
    """All three channels are below zero, where max(0, c) is flat; the photographs are white."""
    fit = _fit(colour=-0.2, target=255)
    before = fit.plan.model.field.sh_dc.detach().clone()
    fit.step()
    assert bool((fit.plan.model.field.sh_dc > before).all())
    for _ in range(30):
        fit.step()
    assert float(fit.plan.model.field.sh_dc.detach().min()) * harmonics.BAND_0 + 0.5 > 0.1
    assert dead_gaussians(fit.plan.model.field, [view.camera for view in fit.plan.scene.train]).share == 0


def test_a_black_gaussian_that_should_be_black_stays() -> None:
    """The gradient that would push a channel further below zero does not pass: colours cannot run away."""
    fit = _fit(colour=-0.2, target=0)
    before = fit.plan.model.field.sh_dc.detach().clone()
    for _ in range(3):
        fit.step()
    assert torch.equal(fit.plan.model.field.sh_dc, before)


@pytest.mark.parametrize(("hooks", "back"), [((LimitsConfig(),), True), ((), False)])
def test_a_saturated_opacity_can_fall_again(hooks: tuple, back: bool) -> None:
    """In float32 sigmoid(17) is 1 and its slope 0. The Gaussian is darker than the photographs, so it should fade."""
    fit = _fit(colour=0.1, target=255, hooks=hooks, logit=17.0)
    cameras = [view.camera for view in fit.plan.scene.train]
    assert bool(dead_gaussians(fit.plan.model.field, cameras).saturated)
    fit.step()
    assert bool(dead_gaussians(fit.plan.model.field, cameras).saturated) != back
    after_one = float(fit.plan.model.field.opacity_logits.detach())
    for _ in range(5):
        fit.step()
    assert (float(fit.plan.model.field.opacity_logits.detach()) < after_one - 0.1) == back


@pytest.mark.parametrize(("hooks", "back"), [((LimitsConfig(),), True), ((), False)])
def test_a_collapsed_scale_can_grow_again(hooks: tuple, back: bool) -> None:
    """A scale of 2e-8 is nothing beside the low-pass filter. The photographs are white like the Gaussian: it should grow."""
    fit = _fit(colour=1.0, target=255, hooks=hooks, log_scale=math.log(2e-8), logit=2.0)
    cameras = [view.camera for view in fit.plan.scene.train]
    assert bool(dead_gaussians(fit.plan.model.field, cameras).collapsed)
    start = fit.plan.model.field.log_scales.detach().clone()
    for _ in range(6):
        fit.step()
    assert bool(dead_gaussians(fit.plan.model.field, cameras).collapsed) != back
    assert bool((fit.plan.model.field.log_scales > start + 1).all()) == back


def test_a_faded_gaussian_is_drawn_and_can_return() -> None:
    """Below 1/255 the rasteriser skips it, and nothing reaches it."""
    fit = _fit(colour=1.0, target=255, logit=-12.0)
    cameras = [view.camera for view in fit.plan.scene.train]
    assert bool(dead_gaussians(fit.plan.model.field, cameras).faded)
    for _ in range(10):
        fit.step()
    assert not bool(dead_gaussians(fit.plan.model.field, cameras).faded)
    assert float(fit.plan.model.field.opacity_logits.detach().sigmoid()) > 0.005


def test_limits_survive_an_interruption_bit_by_bit() -> None:
    whole, first = _fit(1.0, 255, log_scale=-18.0), _fit(1.0, 255, log_scale=-18.0)
    for _ in range(7):
        whole.step()
    for _ in range(4):
        first.step()
    second = _fit(1.0, 255, log_scale=-18.0)
    second.load({part: {k: v.clone() for k, v in tensors.items()} for part, tensors in first.state().items()}, 0.0)
    for _ in range(3):
        second.step()
    for name in PARAMETERS:
        assert torch.equal(getattr(whole.plan.model.field, name), getattr(second.plan.model.field, name)), name


@dataclass(frozen=True)
class _Swap(Hook):
    """Swaps two Gaussians after a step, as density control at its cap does: rows move, their number stays."""

    name = "swap"
    at: int

    def build(self) -> Hook:
        return self

    def after_step(self, state: FitState) -> None:
        if state.step == self.at:
            rows = {name: getattr(state.field, name).detach().flip(0) for name in PARAMETERS}
            replace_rows(state, rows, torch.tensor([1, 0]), 0)


@pytest.mark.parametrize("cut", [4, 5])
@pytest.mark.parametrize("last", [False, True])
def test_limits_follow_rows_that_move(last: bool, cut: int) -> None:
    """A Gaussian near a camera may be finer than a distant one, wherever its row goes, and after an interruption too,
    just before the rows move and just after."""
    hooks = (LimitsConfig(), _Swap(4)) if last else (_Swap(4), LimitsConfig())

    def made() -> Fit:
        fit = _fit(1.0, 255, hooks=hooks, log_scale=-18.0)
        field = fit.plan.model.field
        field.replace({name: getattr(field, name).detach().repeat_interleave(2, dim=0) for name in PARAMETERS})
        with torch.no_grad():
            field.means[1] *= 0
            field.means[1, 2] = -30.0
        return Fit(fit.plan)

    fit = made()
    for _ in range(5 + last):
        fit.step()
    means, log_scales = fit.plan.model.field.means.detach(), fit.plan.model.field.log_scales.detach()
    sizes = pixel_sizes(means, [view.camera for view in fit.plan.scene.train])
    near = int(sizes.argmin())
    assert sizes.max() > 5 * sizes.min()
    assert float(log_scales[near].max()) < float((0.1 * sizes).log().max()) - 1
    resumed = made()
    first = made()
    for _ in range(cut):
        first.step()
    resumed.load({part: {k: v.clone() for k, v in tensors.items()} for part, tensors in first.state().items()}, 0.0)
    for _ in range(8 - cut):
        resumed.step()
    for _ in range(3 - last):
        fit.step()
    for name in PARAMETERS:
        assert torch.equal(getattr(fit.plan.model.field, name), getattr(resumed.plan.model.field, name)), name


def test_causes_are_told_apart() -> None:
    cameras = [view.camera for view in _scene().train]
    field = _fit(0.5, 128).plan.model.field
    field.replace(
        {name: getattr(field, name).detach().repeat(4, *[1] * (getattr(field, name).dim() - 1)) for name in PARAMETERS}
    )
    with torch.no_grad():
        field.opacity_logits[:] = torch.tensor([0.0, 17.0, -9.0, 0.0])
        field.log_scales[3] = math.log(0.5 * COLLAPSED * 0.1)
        field.log_scales[0, 0] = -30.0  # a flat Gaussian is not dead
    dead = dead_gaussians(field, cameras)
    assert dead.saturated.tolist() == [False, True, False, False]
    assert dead.faded.tolist() == [False, False, True, False]
    assert dead.collapsed.tolist() == [False, False, False, True]
    assert dead.share == 0.75
    field.smoothing.fill_(100.0)  # far wider than they are: what is left of their peaks is not drawn
    assert dead_gaussians(field, cameras).faded.tolist() == [True, True, True, True]
    assert "75 % of 4 Gaussians" in dead.sentence()
