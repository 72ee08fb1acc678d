"""Relocation (MCMC): what is seen stays, the dead live again, the cap holds, Adam forgets; and resuming repeats the bits."""

import math
from dataclasses import replace

import pytest
import torch
from test_density_control import XYZ_TO_YZX, _state

from invgraphics.errors import InputError
from invgraphics.training.relocation import RelocationConfig, relocated_opacity


@pytest.mark.parametrize("copies", [1, 2, 5, 30])
@pytest.mark.parametrize("opacity", [0.05, 0.6, 0.99])
def test_copies_look_like_the_one_they_replace(copies: int, opacity: float) -> None:
    """At the centre exactly, and along a line through it in the integral, taken numerically."""
    each, shrink = relocated_opacity(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
    assert 1 - (1 - float(each)) ** copies == pytest.approx(opacity, abs=1e-9)
    x = torch.linspace(-12, 12, 200_001, dtype=torch.float64)
    before = torch.trapezoid(opacity * torch.exp(-x.square() / 2), x)
    after = torch.trapezoid(1 - (1 - each * torch.exp(-(x / shrink).square() / 2)) ** copies, x)
    assert float(after) == pytest.approx(float(before), rel=1e-6)


def test_the_dead_move_onto_the_living() -> None:
    state = _state(6)
    with torch.no_grad():
        state.field.opacity_logits[:] = torch.logit(torch.tensor([0.001, 0.8, 0.002, 0.7, 0.004, 0.9]))
    before = {name: parameter.detach().clone() for name, parameter in state.field.named_parameters()}
    RelocationConfig(every=10, growth=0.0, noise=0.0).build().after_step(state)
    assert state.field.primitive_count() == 6
    alive = before["means"][[1, 3, 5]]
    for row in (0, 2, 4):
        home = (alive == state.field.means[row]).all(dim=1)
        assert int(home.sum()) == 1
        parent = [1, 3, 5][int(home.nonzero())]
        others = [i for i in (0, 2, 4) if bool((state.field.means[i] == before["means"][parent]).all())]
        assert torch.equal(state.field.opacity_logits[row], state.field.opacity_logits[parent])
        together = 1 - (1 - torch.sigmoid(state.field.opacity_logits[parent])) ** (len(others) + 1)
        assert float(together) == pytest.approx(float(torch.sigmoid(before["opacity_logits"][parent])), abs=1e-5)
    moments = state.optimiser.state()
    untouched = [i for i in (1, 3, 5) if torch.equal(state.field.opacity_logits[i], before["opacity_logits"][i])]
    for name in before:
        first = moments[f"field.{name}/exp_avg"]
        assert not first[[0, 2, 4]].any()
        assert all(bool((first[i] != 0).all()) for i in untouched)


def test_growth_ends_at_the_cap() -> None:
    state = _state(20)
    hook = RelocationConfig(every=10, growth=0.3, max_primitives=30, noise=0.0).build()
    counts = []
    for _ in range(4):
        hook.after_step(state)
        counts.append(state.field.primitive_count())
    assert counts == [26, 30, 30, 30]
    assert all(len(value) == 30 for name, value in state.optimiser.state().items() if name.endswith("exp_avg"))


@pytest.mark.parametrize(("quaternion", "deviations"), [((1.0, 0, 0, 0), (0.1, 0.01, 0.001)), (XYZ_TO_YZX, (0.001, 0.1, 0.01))])
def test_noise_moves_the_faint_along_their_long_axis(quaternion: tuple[float, ...], deviations: tuple[float, ...]) -> None:
    """The first axis is the long one; turned, it points along y, and the second along z."""
    state = _state(2000)
    with torch.no_grad():
        state.field.means.zero_()  # so that small steps are not rounded away
        state.field.quaternions[:] = torch.tensor(quaternion)
        state.field.log_scales[:] = torch.tensor([0.1, 0.01, 0.001]).log()
        state.field.opacity_logits[:1000] = math.log(0.001 / 0.999)
        state.field.opacity_logits[1000:] = math.log(0.9 / 0.1)
    before = state.field.means.detach().clone()
    hook = RelocationConfig(every=1000, noise=1e6).build()
    hook.after_step(state)
    moved = state.field.means.detach() - before
    assert not moved[1000:].any()
    # Covariance times normal draws, times gate, learning rate and strength.
    expected = torch.tensor(deviations).square() * float(torch.sigmoid(torch.tensor(100 * 0.004))) * 1e6 * 1e-9
    torch.testing.assert_close(moved[:1000].std(dim=0), expected, rtol=0.1, atol=0)


@pytest.mark.parametrize("dead", [0.005, 0.1])
@pytest.mark.parametrize("gate", [0.005, 0.1])
def test_noise_goes_by_its_own_opacity(dead: float, gate: float) -> None:
    """The standard deviation of the noise is the sigmoid of 100 times (``gate`` less opacity), whatever is relocated."""
    state = _state(2000)
    with torch.no_grad():
        state.field.means.zero_()
        state.field.log_scales.fill_(math.log(0.1))
        state.field.opacity_logits.fill_(math.log(0.05 / 0.95))
    RelocationConfig(every=1000, noise=1e6, dead=dead, gate=gate).build().after_step(state)
    expected = 0.1**2 * 1e6 * 1e-9 / (1 + math.exp(-100 * (gate - 0.05)))
    assert float(state.field.means.detach().std()) == pytest.approx(expected, rel=0.05)


def test_nothing_dead_or_nothing_alive_is_left_alone() -> None:
    for logit in (-9.0, 3.0):
        state = _state(4)
        with torch.no_grad():
            state.field.opacity_logits.fill_(logit)
        before = state.field.means.detach().clone()
        RelocationConfig(every=10, growth=0.0, noise=0.0).build().after_step(state)
        assert torch.equal(state.field.means, before)


def test_the_cap_rises_by_equal_factors() -> None:
    """From 10 to 1000 Gaussians within half of the fit: a quarter of it multiplies them by ten, and growth allows no more."""
    state = _state(10)
    hook = RelocationConfig(every=10, start=0.0, growth=100.0, cap_ramp=0.5, max_primitives=1000, noise=0.0).build()
    for progress, count in ((0.0, 10), (0.25, 100), (0.4, 398), (0.5, 1000), (0.8, 1000)):
        state.ctx = replace(state.ctx, progress=progress)
        hook.after_step(state)
        assert state.field.primitive_count() == count


def test_resuming_gives_the_same_bits(make_fit, scene) -> None:
    more = ["hooks.1.every=5", "hooks.1.start=0.1", "field.count=150", "field.max_init=150", "field.sh_degree=1"]
    whole = make_fit("splatting/gaussians-mcmc", scene, 30, 0, *more)
    whole.run(lambda loss: False)
    first, second = (make_fit("splatting/gaussians-mcmc", scene, 30, 0, *more) for _ in range(2))
    first.run(lambda loss: first.steps == 17)
    kept = {part: {name: value.clone() for name, value in tensors.items()} for part, tensors in first.state().items()}
    second.load(kept, 0.0)
    second.run(lambda loss: False)
    assert whole.plan.model.field.primitive_count() > 150
    for name, value in whole.plan.model.field.state_dict().items():
        assert torch.equal(value, second.plan.model.field.state_dict()[name]), name


def test_refusals(make_fit, scene) -> None:
    with pytest.raises(ValueError, match="every"):
        RelocationConfig(every=0)
    with pytest.raises(ValueError, match="dead"):
        RelocationConfig(dead=0.0)
    with pytest.raises(InputError, match="'relocation' needs Gaussians, which NeuralField does not have"):
        RelocationConfig().build().check(make_fit("volumetric/hash", scene, 1).plan.model.field)
