"""Pose of one photograph in a fitted scene, by gradient descent on its photometric error (iNeRF, Yen-Chen et al. 2021)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from invgraphics.core import Camera, Context, Model, RayRenderer, Scene, View
from invgraphics.scenes.scales import resized_view
from invgraphics.training.optimisers.adam import DenseAdam
from invgraphics.training.poses import motion_about, pivot_depth


@dataclass(frozen=True)
class PoseDescent:
    """Settings of a descent on a pose.

    Attributes:
        steps: of Adam.
        lr: learning rate at the start: radians, and shares of the scene's extent.
        final: at the end.
        scale: image scale.
        rays: random pixels of a step, for renderers of rays; others take the whole picture.
    """

    steps: int
    lr: float = 2e-3
    final: float = 2e-4
    scale: float = 1.0
    rays: int = 1024

    def rate(self, step: int) -> float:
        """Learning rate of a step, log-linear."""
        return self.lr * (self.final / self.lr) ** (step / max(self.steps - 1, 1))


def refine_pose(model: Model, view: View, scene: Scene, descent: PoseDescent) -> Camera:
    """Refine a view's camera to its photograph: a rigid motion in the camera's frame that lowers the photometric error.

    Args:
        model: fitted; not changed.
        view: photograph, and the camera to start from.
        scene: for its bounds, extent and background.
        descent: steps and learning rates. The pixels of all steps are drawn from one fixed seed.
    """
    device = model.device
    small = _at_scale(view, descent.scale)
    twist = torch.zeros(6, device=device, requires_grad=True)
    reach = torch.tensor([1.0] * 3 + [scene.extent] * 3, device=device)
    adam = DenseAdam([{"params": [twist]}], (0.9, 0.999), eps=1e-8)
    generator = torch.Generator().manual_seed(0)
    ctx = model.context()
    start = small.camera.to(device)
    pivot = pivot_depth(start, scene)
    photo = _Photo.of(small, scene, device)
    with _frozen(*model.parts.values()):
        for step in range(descent.steps):
            adam.param_groups[0]["lr"] = descent.rate(step)
            camera = start.moved(start.cam_to_world @ motion_about(twist * reach, pivot))
            colour, target = _predicted_and_true(model, camera, photo, ctx, descent.rays, generator)
            loss = (colour - target).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
    with torch.no_grad():
        pose = start.cam_to_world @ motion_about(twist * reach, pivot)
        return view.camera.moved(pose.to(view.camera.cam_to_world))


def photometric_error(model: Model, view: View, scene: Scene, scale: float = 1.0) -> float:
    """Mean squared error between a view's photograph and its camera's rendering, both over the scene's background."""
    small = _at_scale(view, scale)
    picture = model.render(small.camera, normals=False)
    error = (picture.over(scene.background) - small.over(scene.background)).square()
    return float(error[small.valid()].mean())


def _at_scale(view: View, scale: float) -> View:
    width, height = (max(1, round(edge * scale)) for edge in (view.camera.width, view.camera.height))
    return view if (width, height) == (view.camera.width, view.camera.height) else resized_view(view, width, height)


@dataclass(frozen=True, eq=False)
class _Photo:
    """What a photograph shows, over the scene's background.

    Attributes:
        flat: indices of the k pixels that count.
        colour: theirs, on the model's device.
        background: the scene's, on the model's device.
    """

    flat: Int[Tensor, " k"]
    colour: Float[Tensor, "k 3"]
    background: Float[Tensor, 3]

    @staticmethod
    def of(view: View, scene: Scene, device: torch.device) -> _Photo:
        flat = view.valid().reshape(-1).nonzero()[:, 0]
        return _Photo(flat, view.over(scene.background, flat).to(device), scene.background.to(device))


def _predicted_and_true(
    model: Model, camera: Camera, photo: _Photo, ctx: Context, rays: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Rendered and true colours at the pixels of one step; of a ray renderer at up to ``rays`` random ones."""
    flat, background = photo.flat, photo.background
    if isinstance(model.renderer, RayRenderer):
        chosen = torch.randint(len(flat), (min(rays, len(flat)),), generator=generator)
        pixels = camera.pixel_centres_of(flat[chosen])
        picture, _ = model.renderer.render_rays(model.field, camera.rays(pixels.to(background)), ctx)
        return picture.over(background), photo.colour[chosen.to(background.device)]
    picture, _ = model.renderer.render_image(model.field, camera, ctx)
    return picture.over(background).reshape(-1, 3)[flat.to(background.device)], photo.colour


@contextmanager
def _frozen(*modules: nn.Module) -> Iterator[None]:
    """Within the block, no gradients of the modules' parameters are computed."""
    learning = [parameter for module in modules for parameter in module.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)
