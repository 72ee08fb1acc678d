"""Splatting: depth and normals of a flat splat, a change of frame, empty pictures and the gradients density control reads."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Gaussians, Quantity, Samples
from invgraphics.core.transforms import quaternion_to_matrix, se3_exp
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.renderers.splatting import Splatting, SplattingConfig

F64 = torch.float64
BOUNDS = Bounds(torch.full((3,), -1.5), torch.full((3,), 1.5))


class Fixed(Field):
    """Given Gaussians."""

    provides = Quantity.GAUSSIANS

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians = gaussians

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotImplementedError

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        return self.gaussians


def gaussians(n: int, **given: torch.Tensor) -> Gaussians:
    values = {
        "means": torch.randn(n, 3, dtype=F64) * 0.4,
        "quaternions": torch.randn(n, 4, dtype=F64),
        "scales": torch.rand(n, 3, dtype=F64) * 0.2 + 0.05,
        "opacities": torch.rand(n, dtype=F64) * 0.8 + 0.1,
        "sh": torch.randn(n, 9, 3, dtype=F64) * 0.3,
    }
    return Gaussians(**(values | given))


def test_depth_and_normal_of_a_tilted_disc(make_camera: Callable[..., Camera]) -> None:
    """Small in the image, so that first order suffices: the depth of each pixel is where its ray meets the disc's plane."""
    view = make_camera(12, 10, 1000.0)
    quaternion = torch.tensor([[0.9, 0.5, 0.1, -0.2]], dtype=F64)
    disc = gaussians(
        1,
        means=torch.zeros(1, 3, dtype=F64),
        quaternions=quaternion,
        scales=torch.tensor([[0.05, 0.06, 1e-4]], dtype=F64),
        opacities=torch.ones(1, dtype=F64),
    )
    rendering, _ = Splatting(SplattingConfig()).render_image(Fixed(disc), view, Context(BOUNDS, geometry=True))
    normal = quaternion_to_matrix(quaternion)[0, :, 2]
    rays = view.rays()
    expected = (-(rays.origins @ normal) / (rays.directions @ normal)).view(10, 12)
    seen = rendering.alpha >= 0.5
    assert int(seen.sum()) > 20
    assert float(expected[seen].max() - expected[seen].min()) > 0.01
    torch.testing.assert_close(rendering.depth[seen], expected[seen], atol=2e-4, rtol=0)
    assert bool((rendering.depth[~seen] == torch.inf).all())
    facing = -normal * torch.sign(rays.directions[0] @ normal)
    assert rendering.normal is not None
    torch.testing.assert_close(rendering.normal[seen], facing.expand(int(seen.sum()), 3))


def test_turning_world_and_cameras_together_changes_nothing(make_camera: Callable[..., Camera]) -> None:
    motion, view = se3_exp(torch.tensor([0.7, -1.1, 0.4, 0.3, 2.0, -1.0]).double()), make_camera()
    field, splatting, ctx = Fixed(gaussians(20)), Splatting(SplattingConfig()), Context(BOUNDS, geometry=True)
    moved_view = view.moved(motion @ view.cam_to_world)
    before, _ = splatting.render_image(field, view, ctx)
    after, _ = splatting.render_image(Fixed(transform_gaussians(field.gaussians, motion)), moved_view, ctx)
    unturned, _ = splatting.render_image(field, moved_view, ctx)
    assert before.normal is not None
    assert after.normal is not None
    torch.testing.assert_close(after.rgb, before.rgb, atol=1e-8, rtol=0)
    torch.testing.assert_close(after.depth, before.depth, atol=1e-8, rtol=0)
    torch.testing.assert_close(after.normal, before.normal @ motion[:3, :3].T, atol=1e-8, rtol=0)
    assert float((unturned.rgb - before.rgb).abs().max()) > 0.05


@pytest.mark.parametrize("case", ["none", "all culled"])
@pytest.mark.parametrize("geometry", [False, True])
def test_nothing_to_see_is_an_empty_picture(make_camera: Callable[..., Camera], case: str, geometry: bool) -> None:
    splats = gaussians(0 if case == "none" else 4)
    splats.means.sub_(torch.tensor([0.0, 50.0, 0.0])).requires_grad_()
    ctx = Context(BOUNDS, training=True, geometry=geometry)
    rendering, trace = Splatting(SplattingConfig()).render_image(Fixed(splats), make_camera(), ctx)
    assert rendering.rgb.shape == (10, 12, 3)
    assert not rendering.rgb.any()
    assert not rendering.alpha.any()
    rendering.over(torch.rand(3).double()).sum().backward()
    assert splats.means.grad is not None
    assert not splats.means.grad.any()
    assert trace.screen is not None
    assert not trace.screen.radii.any()


def test_screen_holds_gradients_in_pixels(make_camera: Callable[..., Camera]) -> None:
    """Shifting one splat's image position by a pixel changes the loss by its gradient there."""
    splats, view = gaussians(1, opacities=torch.full((1,), 0.9, dtype=F64)), make_camera()
    splats.means.requires_grad_()
    rendering, trace = Splatting(SplattingConfig()).render_image(Fixed(splats), view, Context(BOUNDS, training=True))
    weight = torch.linspace(-1, 1, 12, dtype=F64).expand(10, 12)
    (rendering.alpha * weight).sum().backward()
    assert trace.screen is not None
    assert trace.screen.means2d.grad is not None
    # The principal point shifts the image position and nothing else (far from the Jacobian's clamp).
    losses = []
    for step in (-1e-4, 1e-4):
        shifted = Camera(view.cam_to_world, view.focal, view.principal_point + torch.tensor([step, 0.0]), 12, 10)
        alpha = Splatting(SplattingConfig()).render_image(Fixed(splats), shifted, Context(BOUNDS, training=True))[0].alpha
        losses.append(float((alpha.detach() * weight).sum()))
    assert float(trace.screen.means2d.grad[0, 0]) == pytest.approx((losses[1] - losses[0]) / 2e-4, rel=1e-4)
    assert (trace.screen.width, trace.screen.height) == (12, 10)


def test_depth_costs_nothing_in_training(make_camera: Callable[..., Camera]) -> None:
    splats, splatting = gaussians(10), Splatting(SplattingConfig())
    lean, _ = splatting.render_image(Fixed(splats), make_camera(), Context(BOUNDS, training=True))
    full, _ = splatting.render_image(Fixed(splats), make_camera(), Context(BOUNDS))
    assert bool((lean.depth == torch.inf).all())
    assert bool((full.depth < torch.inf).any())
    torch.testing.assert_close(lean.rgb, full.rgb)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="dilation"):
        SplattingConfig(dilation=-1.0)
    with pytest.raises(ValueError, match="tile"):
        SplattingConfig(tile=0)
