"""Mip-Splatting's 3D filter: sizes from the cameras, mass kept, recomputed when the number changes."""

import pytest
import torch
from test_density_control import _scene, _state

from invgraphics.core import Context, Quantity
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.training.smoothing import SmoothingConfig, pixel_distances


def test_finest_camera_counts_and_the_unseen_get_the_coarsest() -> None:
    """Two cameras at y = -4 and y = 4 with focal length 40 px."""
    cameras = [view.camera for view in _scene().train]
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 3.9, 0.0], [50.0, 0.0, 0.0]])
    # The third is too near for one camera; the last is outside both pictures.
    expected = torch.tensor([4.0, 3.0, 7.9, 7.9]) / 40
    torch.testing.assert_close(pixel_distances(points, cameras, 0.15, 0.2), expected)
    nobody = pixel_distances(points[3:], cameras, 0.15, 0.2)
    assert not nobody.any()


def test_margin_reaches_outside_the_picture() -> None:
    camera = _scene().train[0].camera
    slope = (16 + 0.1 * 32) / 40  # a tenth of the picture beyond its edge
    point = camera.position + camera.cam_to_world[:3, :3] @ torch.tensor([slope * 2, 0.0, 2.0])
    nearer = camera.position + camera.cam_to_world[:3, :3] @ torch.tensor([0.0, 0.0, 3.0])
    points = torch.stack([point, nearer])
    torch.testing.assert_close(pixel_distances(points, [camera], 0.15, 0.2)[0], torch.tensor(2 / 40))
    torch.testing.assert_close(pixel_distances(points, [camera], 0.05, 0.2)[0], torch.tensor(3 / 40))


def test_smoothed_gaussians_keep_their_integral() -> None:
    scene = _scene()
    field = GaussianFieldConfig(sh_degree=0, count=5, init="random").build(scene)
    with torch.no_grad():
        field.log_scales.copy_(torch.randn(5, 3) * 0.3 - 3)
    ctx = Context(scene.bounds)
    before = field.primitives(Quantity.GAUSSIANS, ctx)
    field.smoothing.fill_(0.05)
    after = field.primitives(Quantity.GAUSSIANS, ctx)
    torch.testing.assert_close(after.scales.square(), before.scales.square() + 0.05**2)
    torch.testing.assert_close(after.opacities * after.scales.prod(dim=1), before.opacities * before.scales.prod(dim=1))


def test_filter_follows_the_number_of_gaussians() -> None:
    state = _state(6)
    hook = SmoothingConfig(every=100).build()
    hook.before_step(state)  # the first computation, whatever the step
    assert bool((state.field.smoothing > 0).all())
    first = state.field.smoothing.clone()
    with torch.no_grad():
        state.field.means.mul_(0.5)
    hook.before_step(state)
    assert torch.equal(state.field.smoothing, first)
    tensors = {name: parameter.detach()[:4] for name, parameter in state.field.named_parameters()}
    state.field.replace(tensors)
    hook.after_step(state)
    assert len(state.field.smoothing) == 4
    expected = pixel_distances(state.field.means, [view.camera for view in state.scene.train], 0.15, 0.2) * 0.2**0.5
    torch.testing.assert_close(state.field.smoothing, expected)


def test_checkpoints_of_other_size_and_without_a_filter_load() -> None:
    scene = _scene()
    field, other = (GaussianFieldConfig(sh_degree=1, count=n, init="random").build(scene) for n in (5, 9))
    field.smoothing.fill_(0.3)
    other.load_state_dict(field.state_dict())
    assert torch.equal(other.smoothing, field.smoothing)
    old = {name: value for name, value in field.state_dict().items() if name != "smoothing"}
    other.load_state_dict(old)
    assert not other.smoothing.any()
    assert len(other.smoothing) == 5


def test_mip_recipe_smooths_from_the_first_step(make_fit, scene) -> None:
    more = ["field.count=60", "field.max_init=60", "field.sh_degree=1", "hooks.1.every=4", "hooks.1.threshold=1e-6"]
    fit = make_fit("splatting/gaussians-mip", scene, 12, 0, *more)
    fit.run(lambda loss: False)
    field = fit.plan.model.field
    assert field.primitive_count() > 60
    assert len(field.smoothing) == field.primitive_count()
    assert bool((field.smoothing > 0).all())


def test_refusals() -> None:
    with pytest.raises(ValueError, match="variance"):
        SmoothingConfig(variance=0.0)


def test_what_a_camera_sees_from_close_by_counts() -> None:
    """A point 0.1 in front of a camera, in a scene whose near plane is at 0.05: its pixels there are finer than any other."""
    state = _state(1)
    camera = state.scene.train[0].camera
    with torch.no_grad():
        state.field.means[0] = camera.position + 0.1 * camera.cam_to_world[:3, 2]
    assert state.scene.bounds.near == 0.05
    SmoothingConfig(variance=1.0).build().before_step(state)
    torch.testing.assert_close(state.field.smoothing, torch.tensor([0.1 / 40]))
