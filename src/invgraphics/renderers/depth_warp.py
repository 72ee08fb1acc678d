"""Depth-image-based rendering: the nearest photographs warped forward by their depth maps (McMillan 1997; Fehn 2004)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Camera, Context, Field, Quantity, Renderer, Rendering, Scene, Trace, View
from invgraphics.renderers.base import MIN_SURFACE_ALPHA, normals_from_depth, to_rendering

LEAST_COVER = 1e-3
"""Bilinear weight from which on a warped pixel takes part in the depth test and covers its target."""


@dataclass(frozen=True)
class DepthWarpConfig:
    """Forward warping of photographs by their depth.

    Attributes:
        views: nearest photographs that are warped, by the distance of their cameras.
        tolerance: pixels up to this share of the distance behind the nearest one count as the same surface.
    """

    title: ClassVar[str] = "depth warping"

    views: int = 2
    tolerance: float = 0.02

    def __post_init__(self) -> None:
        if self.views < 1 or self.tolerance < 0:
            raise ValueError("views must be at least 1, and tolerance not negative.")

    def build(self, scene: Scene) -> DepthWarp:
        """The renderer; it needs nothing from the scene."""
        return DepthWarp(self)


class DepthWarp(Renderer):
    """Splats the pixels of the nearest photographs as points, bilinearly over the four pixels around their images.

    A z-buffer keeps the nearest surface; what remains in a pixel is averaged by bilinear weight and by the inverse square of
    the photograph's distance. Pixels that no photograph reaches stay empty.
    """

    requires: ClassVar[Quantity] = Quantity.DEPTH_MAPS

    def __init__(self, config: DepthWarpConfig) -> None:
        super().__init__()
        self.config = config

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel."""
        views: tuple[View, ...] = field.primitives(Quantity.DEPTH_MAPS, ctx)
        away = torch.stack([(view.camera.position - camera.position).norm() for view in views]).detach()
        nearest = away.argsort(stable=True)[: self.config.views].tolist()
        parts = [_splat(views[index], camera, 1 / float(away[index].clamp_min(1e-3)) ** 2) for index in nearest]
        pixel, weight, distance, values = (torch.cat(column) for column in zip(*parts, strict=True))
        count = camera.width * camera.height
        first = torch.full((count,), torch.inf, dtype=distance.dtype, device=distance.device)
        first = first.scatter_reduce(0, pixel, distance.detach(), "amin")
        kept = distance.detach() <= first[pixel] * (1 + self.config.tolerance)
        weighted = torch.cat([values, distance[:, None], torch.ones_like(distance)[:, None]], dim=1) * (weight * kept)[:, None]
        sums = weighted.new_zeros(count, 6).index_add(0, pixel, weighted)
        mean = (sums[:, :5] / sums[:, 5:].clamp_min(1e-12)).view(camera.height, camera.width, 5)
        alpha = torch.where(sums[:, 5].view(mean.shape[:2]) > 0, mean[..., 3], 0.0)
        rgb, depth = mean[..., :3] * alpha[..., None], mean[..., 4]
        directions, normal = camera.rays().directions.view(*alpha.shape, 3), None
        if ctx.geometry:
            normal = normals_from_depth(depth.detach(), alpha.detach() >= MIN_SURFACE_ALPHA, directions.detach())
        far = torch.full_like(alpha, torch.inf)
        return to_rendering(rgb, alpha, depth * alpha, normal, far, directions), Trace(rays=count)


def _splat(
    view: View, camera: Camera, trust: float
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, "n 4"]]:
    """Warp a photograph's pixels: the target pixels that each touches, weights, distances from ``camera``, colour and alpha."""
    assert view.depth is not None
    depth = view.depth.reshape(-1)
    hit = depth.isfinite().nonzero()[:, 0]
    rays = view.camera.rays()[hit]
    points = rays.origins + depth[hit, None] * rays.directions
    place, z = camera.project(points)
    corner = (place.detach() - 0.5).floor()
    distance = (points - camera.position).norm(dim=1)
    values = torch.cat([view.colour(hit), view.opacity(hit)[:, None]], dim=1)
    parts = []
    for offset in ((0, 0), (1, 0), (0, 1), (1, 1)):
        target = corner + corner.new_tensor(offset)
        weight = (1 - (place - 0.5 - target).abs()).prod(dim=1)
        limit = target.new_tensor([camera.width, camera.height])
        inside = (z > 0) & ((target >= 0) & (target < limit)).all(dim=1) & (weight > LEAST_COVER)
        pixel = (target[:, 1] * camera.width + target[:, 0]).long()
        parts.append((pixel[inside], trust * weight[inside], distance[inside], values[inside]))
    pixel, weight, distance, values = (torch.cat(column) for column in zip(*parts, strict=True))
    return pixel, weight, distance, values
