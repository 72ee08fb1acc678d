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

from invgraphics.conformance import check_field, check_renderer, perturb
from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Points, Quantity, Samples, Scene, View
from invgraphics.core.colour import quantise
from invgraphics.core.transforms import look_at
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig

__all__ = ["Facing", "TwoBalls", "as_class", "check_field", "check_renderer", "perturb", "toy_cameras", "toy_scene"]


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
        return FieldValues(
            density=30.0 * (distance.amin(dim=1) < 0) if Quantity.DENSITY in want else None,
            radiance=self.colours[nearest] * shade if Quantity.RADIANCE in want else None,
        )


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
