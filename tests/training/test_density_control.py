"""Density control against hand-made situations: what must grow grows, what must go goes, Adam's memory follows."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Model, Quantity, Scene, Screen, Trace, View
from invgraphics.core.transforms import look_at, quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.renderers.gaussians.volume import GaussianExactConfig
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.density_control import DensityControlConfig
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.hooks import FitState
from invgraphics.training.losses import PhotometricLoss
from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig

XYZ_TO_YZX = (0.5, 0.5, 0.5, 0.5)
"""The quaternion (w, x, y, z) of the turn that takes +x to +y, +y to +z and +z to +x; its inverse takes +x to +z."""


def _scene() -> Scene:
    eye = torch.tensor([0.0, -4.0, 0.0])
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(pose, torch.tensor([40.0, 40.0]), torch.tensor([16.0, 16.0]), 32, 32)
    other = camera.moved(look_at(-eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])))
    image = torch.zeros(32, 32, 3, dtype=torch.uint8)
    views = (View(camera, image, "a"), View(other, image, "b"))
    return Scene("toy", views, (views[0],), torch.ones(3), Bounds(-torch.ones(3), torch.ones(3)))


def _state(count: int = 6) -> FitState:
    scene = _scene()
    field = GaussianFieldConfig(sh_degree=1, count=count, init="random").build(scene)
    with torch.no_grad():
        field.log_scales.fill_(math.log(1e-3))
        field.opacity_logits.fill_(0.0)
    parameters = {f"field.{name}": parameter for name, parameter in field.named_parameters()}
    optimiser = Optimiser(OptimiserConfig({"all": GroupConfig("field", 1e-9)}), parameters, scene.extent)
    for row, parameter in enumerate(parameters.values()):
        parameter.grad = torch.full_like(parameter, float(row + 1))
    optimiser.step()
    ctx = Context(scene.bounds, training=True, progress=0.3, generator=torch.Generator().manual_seed(1))
    return FitState(field, SplattingConfig().build(scene), optimiser, scene, ctx, step=9)


def _gradients(state: FitState, hook, pixels: list[float], visible: list[bool] | None = None) -> None:
    """Accumulate these screen-space gradients (loss per pixel) of a 32 x 32 image."""
    means2d = torch.zeros(len(pixels), 2, requires_grad=True)
    means2d.grad = torch.stack([torch.tensor(pixels), torch.zeros(len(pixels))], dim=1)
    radii = torch.tensor([1.0 if seen else 0.0 for seen in (visible or [True] * len(pixels))])
    state.trace = Trace(screen=Screen(means2d, radii, 32, 32))
    hook.after_backward(state)


def _end_step(state: FitState, hook) -> None:
    """The end of a step and what comes before the next."""
    hook.after_step(state)
    hook.before_step(state)


def test_small_gaussians_with_large_gradients_are_cloned() -> None:
    state = _state()
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    # 1.0 per unit of NDC is 1/16 per pixel on an image 32 pixels wide.
    _gradients(state, hook, [0.99 / 16, 1.01 / 16, 0.0, 0.0, 0.0, 2.0])
    before = state.field.means.detach().clone()
    hook.after_step(state)
    assert state.field.primitive_count() == 8
    assert torch.equal(state.field.means[:6], before)
    assert torch.equal(state.field.means[6:], before[[1, 5]])


def test_split_discs_stay_on_their_plane() -> None:
    """The parts of a disc differ from it along its first two axes, while those of an ellipsoid leave the plane."""
    for shape, flat in (("disc", True), ("ellipsoid", False)):
        state = _state(8)
        with torch.no_grad():
            state.field.log_scales.fill_(math.log(0.5))
        SplattingConfig(shape=shape).build(state.scene).prepare(state.field)
        hook = DensityControlConfig(every=10, threshold=1.0, prune_extent=9.0).build()
        _gradients(state, hook, [2.0] * 8)
        normals = quaternion_to_matrix(state.field.quaternions.detach())[:, :, 2].repeat(2, 1)
        before = state.field.means.detach().repeat(2, 1)
        hook.after_step(state)
        moved = state.field.means.detach() - before
        assert state.field.primitive_count() == 16 and float(moved.norm(dim=1).min()) > 0.01
        assert (float((moved * normals).sum(dim=1).abs().max()) < 0.01) == flat


def test_gradient_is_averaged_over_the_views_that_see_a_gaussian() -> None:
    state = _state(2)
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    for _ in range(3):
        _gradients(state, hook, [0.0, 0.0], visible=[False, True])
    _gradients(state, hook, [1.5 / 16, 1.5 / 16])
    hook.after_step(state)
    assert state.field.primitive_count() == 3  # the first was seen once: 1.5; the second four times: 0.375


def test_large_gaussians_split_into_two_smaller_ones_nearby() -> None:
    state = _state(3)
    with torch.no_grad():
        state.field.log_scales[1] = math.log(0.5)
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    _gradients(state, hook, [0.0, 1.0, 0.0])
    parent = state.field.means[1].detach().clone()
    hook.after_step(state)
    assert state.field.primitive_count() == 4
    children = slice(2, 4)
    assert torch.allclose(state.field.log_scales[children].exp(), torch.tensor(0.5 / 1.6))
    offsets = (state.field.means[children] - parent).norm(dim=1)
    assert bool((offsets > 0).all()) and bool((offsets < 0.5 * 5).all())


def test_parts_of_a_split_gaussian_lie_along_its_turned_axes() -> None:
    """The long axis points along y, and so do the offsets of two parts of each of 2,000 parents."""
    state = _state(2000)
    with torch.no_grad():
        state.field.means.zero_()
        state.field.quaternions[:] = torch.tensor(XYZ_TO_YZX)
        state.field.log_scales[:] = torch.tensor([0.5, 0.05, 0.005]).log()
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    _gradients(state, hook, [1.0] * 2000)
    hook.after_step(state)
    assert state.field.primitive_count() == 4000
    torch.testing.assert_close(state.field.means.std(dim=0), torch.tensor([0.005, 0.5, 0.05]), rtol=0.1, atol=0)


def test_transparent_gaussians_are_pruned_but_for_one() -> None:
    state = _state(4)
    with torch.no_grad():
        state.field.opacity_logits[:] = torch.tensor([-9.0, 0.0, -9.0, 3.0])
    hook = DensityControlConfig(every=10).build()
    _gradients(state, hook, [0.0] * 4)
    hook.after_step(state)
    assert state.field.primitive_count() == 2
    with torch.no_grad():
        state.field.opacity_logits.fill_(-9.0)
    _gradients(state, hook, [0.0] * 2)
    hook.after_step(state)
    assert state.field.primitive_count() == 1


def test_a_round_says_what_became_of_each_gaussian() -> None:
    state = _state(5)
    with torch.no_grad():
        state.field.opacity_logits[3] = -9.0
        state.field.log_scales[1] = math.log(0.5)
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    assert hook.last_round is None
    _gradients(state, hook, [9.0, 9.0, 0.0, 9.0, 9.0])
    before = state.field.means.detach().clone()
    hook.after_step(state)
    found = hook.last_round
    assert found is not None and found.step == 10
    copies = (before[:, None] == state.field.means[None]).all(dim=2).sum(dim=1)
    assert (copies == 2).tolist() == found.cloned.tolist() == [True, False, False, False, True]
    assert (copies == 0).tolist() == (found.split | found.pruned).tolist()
    assert found.split.tolist() == [False, True, False, False, False]


def test_the_cap_leaves_the_largest_gradients() -> None:
    state = _state(6)
    hook = DensityControlConfig(every=10, threshold=0.1, max_primitives=8).build()
    _gradients(state, hook, [1.0, 6.0, 2.0, 5.0, 3.0, 4.0])
    before = state.field.means.detach().clone()
    hook.after_step(state)
    assert state.field.primitive_count() == 8
    assert torch.equal(state.field.means[6:], before[[1, 3]])


def test_adam_keeps_moments_of_kept_rows_and_has_none_of_new_ones() -> None:
    state = _state(3)
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    _gradients(state, hook, [0.0, 1.0, 0.0])
    hook.after_step(state)
    moments = state.optimiser.state()
    for row, name in enumerate(dict(state.field.named_parameters())):
        first = moments[f"field.{name}/exp_avg"]
        assert torch.allclose(first[:3], torch.tensor(0.1 * (row + 1)))
        assert bool((first[3:] == 0).all())


def test_reset_lowers_opacities_and_arms_pruning_by_size() -> None:
    state = _state(3)
    hook = DensityControlConfig(every=10, resets=(0.25,), prune_opacity=0.005, prune_pixels=0.5).build()
    _gradients(state, hook, [0.0] * 3)
    hook.after_step(state)
    assert float(torch.sigmoid(state.field.opacity_logits.detach()).max()) == 0.5  # until the next step
    hook.before_step(state)
    assert float(torch.sigmoid(state.field.opacity_logits.detach()).max()) == pytest.approx(0.01, abs=1e-6)
    with torch.no_grad():
        state.field.opacity_logits.fill_(0.0)
    _gradients(state, hook, [0.0] * 3, visible=[True, False, False])
    hook.after_step(state)
    assert state.field.primitive_count() == 2


def test_nothing_grows_after_the_end() -> None:
    state = _state(3)
    hook = DensityControlConfig(every=10, threshold=1e-9, stop=0.2).build()
    _gradients(state, hook, [1.0] * 3)
    hook.after_step(state)
    assert state.field.primitive_count() == 3


@pytest.mark.parametrize(("clone", "split", "count"), [(False, True, 4), (True, False, 4), (False, False, 3)])
def test_switched_off_growth_takes_no_room(clone: bool, split: bool, count: int) -> None:
    """Two small Gaussians have the largest gradients, then a large one; without cloning there is room for the large one."""
    state = _state(3)
    with torch.no_grad():
        state.field.log_scales[2] = math.log(0.5)
    hook = DensityControlConfig(every=10, threshold=0.1, clone=clone, split=split, max_primitives=4).build()
    _gradients(state, hook, [3.0, 0.0, 2.0])
    hook.after_step(state)
    assert state.field.primitive_count() == count


def test_absolute_gradients_are_used_where_the_renderer_gathers_them() -> None:
    state = _state(2)
    hook = DensityControlConfig(every=10, threshold=1.0).build()
    means2d, absgrad = torch.zeros(2, 2, requires_grad=True), torch.zeros(2, 2, requires_grad=True)
    means2d.grad, absgrad.grad = torch.zeros(2, 2), torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    state.trace = Trace(screen=Screen(means2d, torch.ones(2), 32, 32, absgrad))
    hook.after_backward(state)
    hook.after_step(state)
    assert state.field.primitive_count() == 3


@pytest.mark.parametrize(("background", "lowered"), [(1.0, True), (0.0, False)])
def test_white_scenes_are_reset_when_growth_begins(background: float, lowered: bool) -> None:
    state = _state(3)
    state.scene = replace(state.scene, background=torch.full((3,), background))
    hook = DensityControlConfig(every=1000, start=0.25, white_reset=True).build()
    state.ctx = replace(state.ctx, progress=0.2)
    _end_step(state, hook)
    assert float(torch.sigmoid(state.field.opacity_logits).min()) == pytest.approx(0.5)
    state.ctx = replace(state.ctx, progress=0.3)
    _end_step(state, hook)
    assert (float(torch.sigmoid(state.field.opacity_logits).max()) < 0.02) == lowered
    with torch.no_grad():
        state.field.opacity_logits.fill_(0.0)
    again = DensityControlConfig(every=1000, start=0.25, white_reset=True).build()
    again.load_state_dict(hook.state_dict())
    _end_step(state, again)
    assert float(torch.sigmoid(state.field.opacity_logits).min()) == pytest.approx(0.5)  # once only


@pytest.mark.parametrize(("step", "lowered"), [(1, False), (498, False), (499, True)])
def test_white_scenes_are_not_reset_before_gaussians_can_recover(step: int, lowered: bool) -> None:
    """3DGS resets after 500 of 30,000 steps; in a budget of a few that share of it would leave nothing to see."""
    state = _state(3)
    state.scene = replace(state.scene, background=torch.ones(3))
    state.step, state.ctx = step, replace(state.ctx, progress=0.4)
    _end_step(state, DensityControlConfig(every=1000, start=0.0167, white_reset=True, reset_spacing=3000).build())
    assert (float(torch.sigmoid(state.field.opacity_logits).max()) < 0.02) == lowered


def test_the_start_of_growth_is_kept_to_the_bit() -> None:
    """Rounded to float32, a resumed fit would have another cap in some rounds."""
    state = _state(3)
    state.ctx = replace(state.ctx, progress=0.1)
    hook, again = (DensityControlConfig(every=1000, start=0.1).build() for _ in range(2))
    hook.after_step(state)
    again.load_state_dict(hook.state_dict())
    assert float(again.state_dict()["started"]) == 0.1


def test_growth_begins_by_steps_where_the_budget_is_long() -> None:
    """At a hundredth of the fit nothing is due by progress; after 500 steps it is, once and for all."""
    state = _state(3)
    state.ctx = replace(state.ctx, progress=0.01)
    hook = DensityControlConfig(every=10, threshold=1.0, start=0.05, latest_start_step=500).build()
    state.step = 489
    _gradients(state, hook, [1.0] * 3)
    hook.after_step(state)
    assert state.field.primitive_count() == 3
    state.step = 509
    hook.after_step(state)
    assert state.field.primitive_count() == 6


@pytest.mark.parametrize(("risen", "most"), [(0.0, 4), (0.25, 8), (0.5, 16), (1.0, 16)])
def test_the_cap_rises_by_equal_factors(risen: float, most: int) -> None:
    """From 4 to 16 Gaussians within half of the fit: a quarter of it doubles them."""
    state = _state(4)
    hook = DensityControlConfig(every=10, threshold=1e-3, start=0.0, stop=1.1, cap_ramp=0.5, max_primitives=16).build()
    state.ctx = replace(state.ctx, progress=0.0)
    _gradients(state, hook, [1.0] * 4)
    hook.after_step(state)
    assert state.field.primitive_count() == 4
    state.ctx = replace(state.ctx, progress=risen)
    for _ in range(3):
        _gradients(state, hook, [1.0] * state.field.primitive_count())
        hook.after_step(state)
    assert state.field.primitive_count() == most


@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.98])
def test_a_clone_and_its_parent_composite_to_the_parents_opacity(opacity: float) -> None:
    """Two in one place transmit (1 - o)², which must be what one transmitted; others keep their opacity."""
    state = _state(3)
    with torch.no_grad():
        state.field.opacity_logits[1] = math.log(opacity / (1 - opacity))
    hook = DensityControlConfig(every=10, threshold=1.0, revised_opacity=True).build()
    _gradients(state, hook, [0.0, 1.0, 0.0])
    hook.after_step(state)
    opacities = state.field.opacity_logits.detach().sigmoid()
    assert len(opacities) == 4
    assert float(opacities[1]) == pytest.approx(float(opacities[3]), rel=1e-6)
    assert float((1 - opacities[1]) * (1 - opacities[3])) == pytest.approx(1 - opacity, rel=1e-4)
    torch.testing.assert_close(opacities[[0, 2]], torch.full((2,), 0.5))


def test_statistics_of_earlier_checkpoints_are_read() -> None:
    hook, old = DensityControlConfig().build(), DensityControlConfig().build()
    names = {"pull": "gradient_sum", "seen": "views", "radius": "max_radius", "first": "first_count"}
    written = hook.state_dict() | {"gradient_sum": torch.ones(3), "views": torch.full((3,), 2.0), "max_radius": torch.zeros(3)}
    written["first_count"] = torch.tensor(7)
    old.load_state_dict({next((first for first, now in names.items() if now == name), name): v for name, v in written.items()})
    for name, value in old.state_dict().items():
        assert torch.equal(value, written[name]), name


def test_resets_and_growth_follow_a_stretched_budget() -> None:
    """40 of 40 steps become 40 of 200: resets at a tenth, a fifth and two fifths of these fall due after 20, 40 and 80."""
    state = _state(4)
    hook, due = DensityControlConfig(start=0.05, every=10_000, resets=(0.1, 0.2, 0.4)).build(), []
    losses, budget = [PhotometricLoss(distance="l1")], Budget(steps=40)
    model = Model(state.field, state.renderer, state.scene.bounds)
    groups = OptimiserConfig({"field": GroupConfig("field", 1e-3)})
    fit = Fit(Plan(model, state.scene, losses, [hook], groups, BatchConfig(), budget))
    reset = hook._reset_opacities
    hook._reset_opacities = lambda state: (due.append(state.step), reset(state))[1]
    fit.run(lambda loss: False)
    assert due == [5, 9, 17] and hook._started == 0.05
    due.clear()
    fit.set_budget(Budget(steps=200))
    fit.run(lambda loss: False)
    assert due == [81]
    assert hook._started == pytest.approx(2 / 200)


def test_resets_that_come_too_soon_are_left_out() -> None:
    """Due at a tenth, a fifth and three tenths, at least 300 steps apart: only the second one happens, resumed or not."""
    hook, lowered = DensityControlConfig(every=10_000, resets=(0.1, 0.2, 0.3), reset_spacing=300).build(), []
    state = _state(3)
    for step, progress in ((200, 0.1), (399, 0.2), (600, 0.3), (601, 0.31)):
        with torch.no_grad():
            state.field.opacity_logits.fill_(0.0)
        state.step, state.ctx = step, replace(state.ctx, progress=progress)
        hook.after_step(state)
        resumed = DensityControlConfig(every=10_000, resets=(0.1, 0.2, 0.3), reset_spacing=300).build()
        resumed.load_state_dict(hook.state_dict())
        hook = resumed
        hook.before_step(state)
        lowered.append(float(torch.sigmoid(state.field.opacity_logits).max()) < 0.02)
    assert lowered == [False, True, False, False]


def test_no_reset_where_density_control_is_off() -> None:
    """``stop = 0`` leaves the Gaussians as they are: opacities too, scheduled or at the start against white."""
    state = _state(3)
    state.scene = replace(state.scene, background=torch.ones(3))
    hook = DensityControlConfig(stop=0, every=10, start=0.1, resets=(0.2,), white_reset=True).build()
    for step, progress in ((700, 0.15), (900, 0.25), (901, 0.26)):
        state.step, state.ctx = step, replace(state.ctx, progress=progress)
        _end_step(state, hook)
    assert float(torch.sigmoid(state.field.opacity_logits).min()) == pytest.approx(0.5)


def test_no_reset_after_density_control_has_ended() -> None:
    """As in 3DGS's code: what a reset lowers would never be pruned."""
    state, hook = _state(3), DensityControlConfig(start=0.0, stop=0.2, every=10_000, resets=(0.1, 0.3)).build()
    lowered = []
    for step, progress in ((700, 0.15), (900, 0.35)):
        with torch.no_grad():
            state.field.opacity_logits.fill_(0.0)
        state.step, state.ctx = step, replace(state.ctx, progress=progress)
        _end_step(state, hook)
        lowered.append(float(torch.sigmoid(state.field.opacity_logits).max()) < 0.02)
    assert lowered == [True, False]


def test_rays_do_not_grow_gaussians() -> None:
    """They have no gradients on a screen: the hook would do nothing but its resets."""
    state, hook = _state(3), DensityControlConfig().build()
    with pytest.raises(InputError, match="'density_control' needs a renderer that splats"):
        hook.check_fit(state.field, GaussianExactConfig().build(state.scene))
    hook.check_fit(state.field, SplattingConfig().build(state.scene))


def test_large_gaussians_stay_until_a_reset_has_happened() -> None:
    """One that is due but left out says nothing about how long the Gaussians have had to shrink."""
    state = _state(3)
    with torch.no_grad():
        state.field.log_scales[2] = math.log(0.9 * state.scene.extent)
    for spacing, count in ((10**6, 3), (0, 2)):
        hook = DensityControlConfig(every=10, threshold=1e9, resets=(0.0,), reset_spacing=spacing, prune_opacity=1e-9).build()
        for _ in range(2):
            _gradients(state, hook, [0.0] * 3)
            hook.after_step(state)
        assert state.field.primitive_count() == count


def test_a_reset_lowers_what_is_seen_through_the_filter() -> None:
    """A flat Gaussian keeps a quarter of its opacity behind the filter: a reset of what is stored would hide it for good."""
    state = _state(3)
    pixel = 4.0 / 40
    with torch.no_grad():
        state.field.log_scales[:] = torch.tensor([[2.0, 2.0, 0.1], [1.0, 1.0, 1.0], [2.0, 2.0, 0.1]]).mul(pixel).log()
        state.field.opacity_logits[2] = math.log(0.002 / 0.998)
        state.field.smoothing.fill_(0.447 * pixel)
    before = _integrals(state)
    hook = DensityControlConfig(every=10, resets=(0.25,)).build()
    _end_step(state, hook)
    seen = state.field.primitives(Quantity.GAUSSIANS, Context(state.scene.bounds)).opacities.detach()
    torch.testing.assert_close(seen[:2], torch.full((2,), 0.01))
    after = _integrals(state)
    # What a Gaussian holds in all falls as its peak does, for the filter keeps the integral of what is stored.
    torch.testing.assert_close(after[2], before[2])
    torch.testing.assert_close(after[:2] / before[:2], torch.sigmoid(state.field.opacity_logits[:2]).detach() / 0.5)


def _integrals(state: FitState) -> torch.Tensor:
    """Integral of opacity times response over space, by quadrature of the Gaussians that are rendered."""
    gaussians = state.field.primitives(Quantity.GAUSSIANS, Context(state.scene.bounds))
    z = torch.linspace(-8, 8, 4001)
    along_an_axis = torch.trapezoid(torch.exp(-0.5 * z**2), z)
    return (gaussians.opacities * (gaussians.scales * along_an_axis).prod(dim=1)).detach()


def test_cloning_by_ordinary_and_splitting_by_absolute_gradients() -> None:
    """AbsGS: opposite pulls of a Gaussian's pixels cancel in the one and not in the other; three small, three large ones."""
    state = _state(6)
    with torch.no_grad():
        state.field.log_scales[3:] = math.log(0.5)
    means2d, absgrad = torch.zeros(6, 2, requires_grad=True), torch.zeros(6, 2, requires_grad=True)
    ordinary = torch.tensor([0.0, 0.15, 0.05, 0.0, 0.15, 0.0]) / 16
    absolute = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.15, 0.19]) / 16
    means2d.grad, absgrad.grad = (torch.stack([values, torch.zeros(6)], dim=1) for values in (ordinary, absolute))
    state.trace = Trace(screen=Screen(means2d, torch.ones(6), 32, 32, absgrad))
    hook = DensityControlConfig(every=10, threshold=0.1, split_threshold=0.2).build()
    hook.after_backward(state)
    resumed = DensityControlConfig(every=10, threshold=0.1, split_threshold=0.2).build()
    resumed.load_state_dict(hook.state_dict())
    resumed.after_step(state)
    assert resumed.last_round.cloned.tolist() == [False, True, False, False, False, False]
    assert resumed.last_round.split.tolist() == [False, False, False, True, False, False]
