"""Splatting: explicit primitives projected to the screen, sorted, and composited (Zwicker et al. 2001; Kerbl et al. 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Camera, Context, Field, Gaussians, Quantity, Renderer, Rendering, Scene, Screen, Trace
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.types import Footprints
from invgraphics.renderers.base import picture


@dataclass(frozen=True)
class SplattingConfig:
    """Rasterised anisotropic Gaussians.

    Attributes:
        dilation: variance in square pixels added to every footprint (low-pass filter).
        tile: edge of a tile in pixels; ``None`` leaves it to the kernel.
    """

    dilation: float = 0.3
    tile: int | None = None

    def __post_init__(self) -> None:
        if self.dilation < 0:
            raise ValueError(f"dilation must not be negative, not {self.dilation}")
        if self.tile is not None and self.tile < 1:
            raise ValueError(f"tile must be at least 1, not {self.tile}")

    def build(self, scene: Scene) -> Splatting:
        """The renderer; it needs nothing from the scene."""
        return Splatting(self)


class Splatting(Renderer):
    """Projects a field's Gaussians by EWA splatting and composites them front to back."""

    requires: ClassVar[Quantity] = Quantity.GAUSSIANS

    def __init__(self, config: SplattingConfig) -> None:
        super().__init__()
        self.config = config

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel. Depth is left at infinity in training, unless ``ctx.geometry`` asks for it."""
        gaussians: Gaussians = field.primitives(Quantity.GAUSSIANS, ctx)
        footprints, rgb = kernels.splat_project(gaussians, camera, self.config.dilation)
        if footprints.means2d.requires_grad:
            footprints.means2d.retain_grad()
        features = [rgb]
        if ctx.geometry or not ctx.training:
            features.append(_distance_coefficients(footprints))
        if ctx.geometry:
            features.append(_normals(gaussians, camera))
        sums, alpha = kernels.splat_rasterise(
            footprints, torch.cat(features, dim=1), camera.width, camera.height, self.config.tile
        )
        screen = Screen(footprints.means2d, footprints.radii, camera.width, camera.height)
        return _picture(sums, alpha, camera), Trace(screen=screen, rays=alpha.numel())


def _picture(sums: Float[Tensor, "h w c"], alpha: Float[Tensor, "h w"], camera: Camera) -> Rendering:
    """Take the pixel sums apart: colour, then three distance coefficients, then the normal, as far as they are there."""
    far = torch.full_like(alpha, torch.inf)
    if sums.shape[2] == 3:
        return Rendering(sums, alpha, far)
    homogeneous = torch.nn.functional.pad(camera.pixel_centres(), (0, 1), value=1.0)
    distance = (sums[..., 3:6] * homogeneous).sum(dim=2)
    normal = sums[..., 6:] if sums.shape[2] > 6 else None
    directions = camera.rays().directions.view(*alpha.shape, 3)
    return picture(sums[..., :3], alpha, distance, normal, far, directions)


def _distance_coefficients(footprints: Footprints) -> Float[Tensor, "n 3"]:
    """`Footprints.planes` rewritten as t = k_x x + k_y y + k_1, whose coefficients can be summed over splats."""
    at_mean, slopes = footprints.planes[:, :1], footprints.planes[:, 1:]
    return torch.cat([slopes, at_mean - (slopes * footprints.means2d).sum(dim=1, keepdim=True)], dim=1)


def _normals(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """The shortest axis of each Gaussian, turned towards the camera."""
    shortest = gaussians.scales.argmin(dim=1)
    axes = quaternion_to_matrix(gaussians.quaternions)
    normal = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    away = (normal * (gaussians.means - camera.position)).sum(dim=1, keepdim=True) > 0
    return torch.where(away, -normal, normal)
