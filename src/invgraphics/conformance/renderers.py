"""Conformance suite of renderers: pictures of the right shapes, ranges and places, repeatable and differentiable."""

from __future__ import annotations

from dataclasses import replace

import torch

from invgraphics.conformance.fields import perturb
from invgraphics.core import Camera, Context, Field, Quantity, RayRenderer, Renderer, Samples, Scene, check
from invgraphics.core.rendering import Rendering


def check_renderer(renderer: Renderer, field: Field, scene: Scene) -> None:
    """Assert the contract of a renderer: shapes, ranges, repeatability, and gradients to the field and the pose.

    Colours are premultiplied, normals of unit length and towards the camera; where alpha is below 1/2, depth is infinite and no
    normal is given. Pixels are where the camera sees them, and rays independent of each other.

    Args:
        renderer: any.
        field: that it can show, and that looks different from elsewhere: of an opaque ball of one colour hardly any pixel does.
        scene: whose first test camera is taken.
    """
    check(field, renderer)
    camera = scene.test[0].camera.resized(12, 9)
    ctx = Context(scene.bounds, geometry=True)
    first, _ = renderer.render_image(field, camera, ctx)
    again, _ = renderer.render_image(field, camera, ctx)
    assert first.rgb.shape == (9, 12, 3) and first.alpha.shape == (9, 12) and first.depth.shape == (9, 12)
    assert torch.equal(first.rgb, again.rgb), "evaluation must be deterministic"
    _check_picture(first.detach(), camera)
    if _colours_in_range(field, ctx):
        excess = float((first.rgb - first.alpha[..., None]).detach().max())
        assert excess <= 1e-3, f"colours are not premultiplied: one is {excess:.3g} above alpha"
    _check_pixels(renderer, field, camera, ctx)
    turned = camera.cam_to_world @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away, _ = renderer.render_image(field, camera.moved(turned), ctx)
    assert away.rgb.shape == (9, 12, 3) and bool(away.rgb.isfinite().all()) and bool(away.alpha.isfinite().all()), (
        "a camera that looks away from the scene must get a picture"
    )
    _check_gradients(renderer, field, camera, scene)


def _check_pixels(renderer: Renderer, field: Field, camera: Camera, ctx: Context) -> None:
    """Assert that pixels are where the camera sees them, and that rays do not depend on each other.

    A principal point one pixel to the right moves the picture by one pixel. Rays in another order have the same colours, depth
    within the bounds, and alpha the sum of the weights of their own samples.
    """
    picture, _ = renderer.render_image(field, camera, ctx)
    moved = replace(camera, principal_point=camera.principal_point + camera.principal_point.new_tensor([1.0, 0.0]))
    shifted, _ = renderer.render_image(field, moved, ctx)
    off = (shifted.rgb[:, 1:] - picture.rgb[:, :-1]).abs().mean()
    still = (shifted.rgb[:, 1:] - picture.rgb[:, 1:]).abs().mean()
    assert off <= 0.1 * still + 1e-3, "the picture does not move with the camera's principal point"
    if not isinstance(renderer, RayRenderer):
        return
    rays = camera.rays()
    order = torch.randperm(len(rays))
    one, trace = renderer.render_rays(field, rays, ctx)
    other, _ = renderer.render_rays(field, rays[order], ctx)
    assert torch.allclose(one.rgb[order], other.rgb, atol=1e-3), "the colour of a ray depends on those before it"
    clipped, solid = ctx.bounds.clip(rays), one.alpha >= 0.5
    inside = (one.depth >= clipped.near - 1e-3) & (one.depth <= clipped.far + 1e-3)
    assert bool(inside[solid].all()), "depth must lie within the bounds"
    if trace.weights is not None and trace.samples is not None:
        alpha = one.alpha.new_zeros(len(rays)).index_add(0, trace.samples.ray, trace.weights)
        assert torch.allclose(alpha, one.alpha, atol=1e-3), "alpha is not the sum of the samples' weights"


def _check_gradients(renderer: Renderer, field: Field, camera: Camera, scene: Scene) -> None:
    """Assert that gradients of a training picture reach the pose and the field, which is not a new one: those are constant."""
    new = {name: value.clone() for name, value in field.state_dict().items()}
    perturb(field)
    pose = camera.cam_to_world.clone().requires_grad_(True)
    training = Context(scene.bounds, training=True, generator=torch.Generator().manual_seed(0))
    picture, _ = renderer.render_image(field, camera.moved(pose), training)
    picture.over(torch.ones(3)).square().mean().backward()
    assert pose.grad is not None and bool((pose.grad != 0).any()), "no gradient reaches the pose"
    assert bool(pose.grad.isfinite().all()), "the gradient of the pose is not finite"
    gradients = [parameter.grad for parameter in field.parameters() if parameter.requires_grad]
    assert not gradients or any(grad is not None and bool((grad != 0).any()) for grad in gradients), (
        "no gradient reaches the field"
    )
    field.load_state_dict(new)


def _check_picture(picture: Rendering, camera: Camera) -> None:
    """Assert ranges of colour, alpha and depth, and unit normals towards the camera; no surface where alpha is below 1/2."""
    assert bool(picture.rgb.isfinite().all()), "a colour is not finite"
    assert bool((picture.alpha >= 0).all()) and bool((picture.alpha <= 1 + 1e-4).all()), "alpha leaves [0, 1]"
    solid = picture.alpha >= 0.5
    assert bool((picture.depth[solid] > 0).all()), "depth must be positive where something is"
    assert bool(picture.depth[~solid].isposinf().all()), "depth must be infinite where alpha is below 1/2"
    if picture.normal is not None:
        length = picture.normal.norm(dim=-1)
        assert bool((((length - 1).abs() < 1e-3) | (length == 0)).all()), "a normal is neither of unit length nor 0"
        assert bool((length[~solid] == 0).all()), "there is a normal where alpha is below 1/2"
        directions = camera.rays().directions.view(*length.shape, 3)
        assert bool(((picture.normal * directions).sum(dim=-1) < 1e-3).all()), "a normal points away from the camera"


def _colours_in_range(field: Field, ctx: Context) -> bool:
    """Whether a field is known to have colours in [0, 1] only, as far as samples of them tell."""
    if Quantity.RADIANCE not in field.provides:
        return False
    direction = torch.nn.functional.normalize(torch.randn(512, 3), dim=1)
    values = field.query_no_grad(Samples.at(ctx.bounds.from_unit(torch.rand(512, 3)), direction), Quantity.RADIANCE)
    return values.radiance is not None and bool((values.radiance <= 1).all())
