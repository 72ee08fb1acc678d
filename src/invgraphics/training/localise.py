"""Pose of one photograph in a fitted scene, by gradient descent on its photometric error (iNeRF, Yen-Chen et al. 2021)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from invgraphics.core import Batch, Camera, Context, Model, RayRenderer, Scene, View
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
    with _frozen(*model.parts.values()):
        for step in range(descent.steps):
            adam.param_groups[0]["lr"] = descent.rate(step)
            camera = start.moved(start.cam_to_world @ motion_about(twist * reach, pivot))
            colour, target = _predicted_and_true(model, camera, small, scene, ctx, descent.rays, generator)
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
    valid = torch.ones_like(small.opacity(), dtype=torch.bool) if small.mask is None else small.mask
    error = (picture.over(scene.background) - small.over(scene.background)).square()
    return float(error[valid].mean())


def _at_scale(view: View, scale: float) -> View:
    width, height = (max(1, round(edge * scale)) for edge in (view.camera.width, view.camera.height))
    return view if (width, height) == (view.camera.width, view.camera.height) else resized_view(view, width, height)


def _predicted_and_true(
    model: Model, camera: Camera, view: View, scene: Scene, ctx: Context, rays: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Rendered and true colours at the pixels of one step; of a ray renderer at up to ``rays`` random ones."""
    background = scene.background.to(camera.focal.device)
    batch = Batch(view.over(scene.background), view.opacity(), background)
    valid = torch.arange(batch.alpha.numel()) if view.mask is None else view.mask.reshape(-1).nonzero()[:, 0]
    if isinstance(model.renderer, RayRenderer):
        flat = valid[torch.randint(len(valid), (min(rays, len(valid)),), generator=generator)]
        pixels = camera.pixel_centres_of(flat)
        picture, _ = model.renderer.render_rays(model.field, camera.rays(pixels.to(background)), ctx)
        return picture.over(background), batch.target.reshape(-1, 3)[flat].to(background)
    picture, _ = model.renderer.render_image(model.field, camera, ctx)
    where = valid.to(background.device)
    return picture.over(background).reshape(-1, 3)[where], batch.target.to(background).reshape(-1, 3)[where]


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
