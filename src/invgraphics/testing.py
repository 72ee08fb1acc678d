"""Test utilities, also for plug-ins: a small scene with known truth, and conformance suites for fields and renderers.

A plug-in's test needs three lines::

    from invgraphics.testing import check_field, toy_scene
    scene = toy_scene()
    check_field(MyFieldConfig().build(scene), scene)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from invgraphics.core import (
    Bounds,
    Camera,
    Context,
    Field,
    FieldValues,
    Points,
    Quantity,
    Renderer,
    Samples,
    Scene,
    View,
    check,
)
from invgraphics.core.colour import quantise
from invgraphics.core.transforms import look_at
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig

_POINTWISE = {
    Quantity.DENSITY: "density",
    Quantity.SDF: "sdf",
    Quantity.GRADIENT: "gradient",
    Quantity.RADIANCE: "radiance",
    Quantity.NORMAL: "normal",
    Quantity.FEATURES: "features",
}


class TwoBalls(Field):
    """A red and a blue ball of dense fog, shaded by height: enough structure for poses and colours to matter.

    Args:
        checks: changes of shade per local unit along each axis; 0 leaves the balls plain.
    """

    provides = Quantity.DENSITY | Quantity.RADIANCE
    centres: Tensor
    radii: Tensor
    colours: Tensor

    def __init__(self, checks: float = 0.0) -> None:
        super().__init__()
        self.checks = checks
        self.register_buffer("centres", torch.tensor([[-0.35, 0.1, -0.1], [0.4, -0.15, 0.25]]))
        self.register_buffer("radii", torch.tensor([0.45, 0.3]))
        self.register_buffer("colours", torch.tensor([[0.9, 0.25, 0.15], [0.15, 0.35, 0.9]]))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Constant density in each ball; colour of the nearer ball, darker below."""
        distance = (samples.position[:, None] - self.centres).norm(dim=-1) - self.radii
        nearest = distance.argmin(dim=1)
        shade = 0.7 + 0.3 * samples.position[:, 2:].clamp(-1, 1)
        # Odd cells of a checkerboard are half as bright; without checks every position is in cell 0.
        odd = (samples.position * self.checks).floor().sum(dim=1, keepdim=True) % 2
        shade = shade * (1 - 0.5 * odd)
        return FieldValues(density=30.0 * (distance.amin(dim=1) < 0), radiance=self.colours[nearest] * shade)


Facing = Literal["around", "forward"]


def toy_cameras(count: int, size: int, turn: float = 0.0, zoom: float = 1.0, facing: Facing = "around") -> list[Camera]:
    """Place cameras on a spiral around the origin at distance 3; all of [-1, 1]³ is in view unless ``zoom`` exceeds 1.

    With ``facing = "forward"`` the spiral lies on a disc of radius 0.6 before the origin, at y = -3.
    """
    cameras = []
    for i in range(count):
        azimuth = 2 * math.pi * (i * 0.618034 + turn)
        height = -0.5 + 1.4 * (i + 0.5) / count
        eye = 3 * torch.tensor([math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)])
        if facing == "forward":
            radius = 0.6 * math.sqrt((i + 0.5) / count)
            eye = torch.tensor([radius * math.cos(azimuth), -3.0, radius * math.sin(azimuth)])
        pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        cameras.append(Camera(pose, torch.full((2,), 1.3 * zoom * size), torch.full((2,), size / 2), size, size))
    return cameras


def toy_scene(
    views: int = 12,
    size: int = 24,
    space: Literal["box", "contracted"] = "box",
    checks: float = 0.0,
    zoom: float = 1.0,
    facing: Facing = "around",
) -> Scene:
    """Make a scene of two balls of fog with alpha, points and a white background; fits in well under a second.

    Args:
        views: training views.
        size: width and height of the pictures in pixels.
        space: kind of bounds.
        checks: fineness of a checkerboard on the balls (see `TwoBalls`).
        zoom: multiplies the focal length; the balls fill the pictures at 1.35.
        facing: whether cameras surround the balls, or see them from one side.
    """
    bounds = Bounds(-torch.ones(3), torch.ones(3), space)
    truth, field = VolumetricConfig(StratifiedConfig(count=128)), TwoBalls(checks)
    box = Context(Bounds(-torch.ones(3), torch.ones(3)))

    def view(camera: Camera, name: str) -> View:
        with torch.no_grad():
            picture, _ = truth.build(scene).render_image(field, camera, box)
        straight = picture.rgb / picture.alpha[..., None].clamp_min(1e-3)
        depth = torch.where(picture.alpha >= 0.5, picture.depth, torch.inf)
        return View(camera, quantise(straight), name, alpha=quantise(picture.alpha), depth=depth)

    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    which = torch.arange(400) % 2
    points = Points(field.centres[which] + field.radii[which][:, None] * directions, field.colours[which])
    scene = Scene("toy", (), (), torch.ones(3), bounds, points=points)
    train = tuple(view(camera, f"train{i}") for i, camera in enumerate(toy_cameras(views, size, 0.0, zoom, facing)))
    test = tuple(view(camera, f"test{i}") for i, camera in enumerate(toy_cameras(max(2, views // 4), size, 0.3, zoom, facing)))
    return scene.with_views(train=train, test=test)


def as_class(scene: Scene) -> Scene:
    """Make a class of objects of a scene: its training views show instances 0 and 1, half each, its test view instance 2.

    Args:
        scene: of one subject, with two test views or more; the last of them is observed.
    """

    def of(views: Sequence[View], first: int, each: int) -> tuple[View, ...]:
        return tuple(replace(view, subject=first + index // each) for index, view in enumerate(views))

    train, last = of(scene.train, 0, -(-len(scene.train) // 2)), len(scene.test) - 1
    return replace(scene, train=train, test=of(scene.test[:1], 2, 1), observed=of(scene.test[last:], 2, 1))


def perturb(field: Field, amount: float = 0.01) -> None:
    """Add normal noise to a field's parameters: a new lattice is constant, where no normal is defined.

    Args:
        field: it is changed in place, by torch's global generator.
        amount: standard deviation.
    """
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(amount * torch.randn_like(parameter))


def check_field(field: Field, scene: Scene) -> None:
    """Assert the contract of a field: shapes, finiteness, only requested quantities, gradients, a state that reloads.

    Its parameters are perturbed before (see `perturb`) and put back afterwards.
    """
    new = {name: value.clone() for name, value in field.state_dict().items()}
    unfit = [name for name, value in new.items() if not bool(value.isfinite().all())]
    assert not unfit, f"not finite in a new field, which stops every fit: {unfit}"
    perturb(field)
    pointwise = [quantity for quantity in _POINTWISE if quantity in field.provides]
    position = scene.bounds.from_unit(torch.rand(37, 3)).requires_grad_(True)
    direction = torch.nn.functional.normalize(torch.randn(37, 3), dim=1)
    for quantity in pointwise:
        values = field.query(Samples.at(position, direction), quantity)
        value = getattr(values, _POINTWISE[quantity])
        assert value is not None, f"asked for {quantity.words()}, got nothing"
        shape = (37,) if quantity in (Quantity.DENSITY, Quantity.SDF) else (37, value.shape[-1])
        assert tuple(value.shape) == shape, f"the shape of {quantity.words()} of 37 samples is {tuple(value.shape)}"
        assert bool(value.isfinite().all()), f"{quantity.words()} is not finite"
        if quantity in (Quantity.RADIANCE, Quantity.NORMAL):
            assert value.shape[1] == 3, f"{quantity.words()} has {value.shape[1]} components"
        if quantity is Quantity.DENSITY:
            assert bool((value >= 0).all()), "a density is negative"
        if quantity is Quantity.FEATURES:
            assert value.shape[1] == field.feature_width, "feature_width is not the number of features"
        if quantity is Quantity.NORMAL:
            empty = torch.zeros(37, dtype=torch.bool)
            if Quantity.DENSITY in field.provides:
                density = field.query(Samples.at(position, direction), Quantity.DENSITY).density
                empty = torch.zeros_like(empty) if density is None else density == 0
            length = value.norm(dim=1)
            assert bool((((length - 1).abs() < 1e-3) | empty).all()), "a normal is not of unit length"
        empty = field.query(Samples.at(position[:0], direction[:0]), quantity)
        assert len(getattr(empty, _POINTWISE[quantity])) == 0, "no samples must give no values"
    if Quantity.GRADIENT in field.provides:
        _check_gradient(field, Samples.at(position, direction))
    assert pointwise or field.provides, "a field must provide something"
    state = {name: value.clone() for name, value in field.state_dict().items()}
    field.load_state_dict(state)
    field.load_state_dict(new)


def _check_gradient(field: Field, samples: Samples) -> None:
    """Assert that a raw gradient can be had outside the graph, is in it when training, and is what normals are made of."""
    assert Quantity.SDF in field.provides, "a gradient is that of a signed distance, which the field does not provide"
    gradient = field.query(samples, Quantity.SDF | Quantity.GRADIENT).gradient
    outside = field.query_no_grad(samples, Quantity.GRADIENT | (field.provides & Quantity.NORMAL))
    assert gradient is not None and outside.gradient is not None, "asked for a gradient, got nothing"
    assert torch.allclose(gradient, outside.gradient, atol=1e-4), "the gradient is another one inside no_grad"
    assert not outside.gradient.requires_grad, "a gradient inside no_grad is in the graph"
    assert gradient.requires_grad, "the gradient at positions that are in the graph is not in it"
    if outside.normal is not None:
        assert torch.allclose(outside.normal, torch.nn.functional.normalize(outside.gradient, dim=1), atol=1e-4), (
            "a normal is not the normalised gradient"
        )


def check_renderer(renderer: Renderer, field: Field, scene: Scene) -> None:
    """Assert the contract of a renderer: shapes, ranges, repeatability, gradients to the field and the pose."""
    check(field, renderer)
    camera = scene.test[0].camera.resized(12, 9)
    ctx = Context(scene.bounds, geometry=True)
    first, _ = renderer.render_image(field, camera, ctx)
    again, _ = renderer.render_image(field, camera, ctx)
    assert first.rgb.shape == (9, 12, 3) and first.alpha.shape == (9, 12) and first.depth.shape == (9, 12)
    assert torch.equal(first.rgb, again.rgb), "evaluation must be deterministic"
    assert bool(first.rgb.isfinite().all()) and bool((first.alpha >= 0).all()) and bool((first.alpha <= 1 + 1e-4).all())
    assert bool((first.depth[first.alpha >= 0.5] > 0).all()), "depth must be positive where something is"
    turned = camera.cam_to_world @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away, _ = renderer.render_image(field, camera.moved(turned), ctx)
    assert away.rgb.shape == (9, 12, 3) and bool(away.rgb.isfinite().all()) and bool(away.alpha.isfinite().all()), (
        "a camera that looks away from the scene must get a picture"
    )
    pose = camera.cam_to_world.clone().requires_grad_(True)
    training = Context(scene.bounds, training=True, generator=torch.Generator().manual_seed(0))
    picture, _ = renderer.render_image(field, camera.moved(pose), training)
    picture.over(torch.ones(3)).square().mean().backward()
    assert pose.grad is not None and bool(pose.grad.isfinite().all()), "no gradient reaches the pose"
    gradients = [parameter.grad for parameter in field.parameters() if parameter.requires_grad]
    assert not gradients or any(grad is not None and bool((grad != 0).any()) for grad in gradients), (
        "no gradient reaches the field"
    )
