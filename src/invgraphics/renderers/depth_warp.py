"""Depth-image-based rendering: the nearest photographs warped forward by their depth maps (McMillan 1997; Fehn 2004)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core import Camera, Context, Field, Quantity, Renderer, Rendering, Scene, Trace, View
from invgraphics.core.scene import DepthMaps
from invgraphics.renderers.base import MIN_SURFACE_ALPHA, normals_from_depth, to_rendering

LEAST_COVER = 1e-3
"""Bilinear weight from which on a warped pixel covers its target at all."""
OCCLUDES = 0.2
"""Bilinear weight from which on it takes part in the depth test, unless nothing else reaches its target. With less, surfaces
grow by a pixel on all sides; with 0.25, gaps open where they are magnified."""


@dataclass(frozen=True)
class DepthWarpConfig:
    """Forward warping of photographs by their depth.

    Attributes:
        views: nearest photographs that are warped, by the distance of their cameras; all but the first fill gaps only.
        tolerance: pixels up to this share of the distance behind the nearest one count as the same surface.
    """

    title: ClassVar[str] = "depth warping"

    views: int = 4
    tolerance: float = 0.02

    def __post_init__(self) -> None:
        if self.views < 1 or self.tolerance < 0:
            raise ValueError("views must be at least 1, and tolerance not negative.")

    def build(self, scene: Scene) -> DepthWarp:
        """The renderer; it needs nothing from the scene."""
        return DepthWarp(self)


class DepthWarp(Renderer):
    """Splats the pixels of the nearest photograph as points, bilinearly over the four pixels around their images.

    A z-buffer keeps the nearest surface, whose points are averaged by bilinear weight. The next nearest photographs, each
    warped likewise, fill what is still empty; pixels that none of them reaches stay empty.
    """

    requires: ClassVar[Quantity] = Quantity.DEPTH_MAPS

    def __init__(self, config: DepthWarpConfig) -> None:
        super().__init__()
        self.config = config

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel."""
        maps: DepthMaps = field.primitives(Quantity.DEPTH_MAPS, ctx)
        away = torch.stack([(one.position - camera.position).norm() for one in maps.cameras]).detach()
        means, filled = self._warp(maps.view(int(away.argmin())), camera)
        for index in away.argsort(stable=True)[1 : self.config.views].tolist():
            more, reached = self._warp(maps.view(index), camera)
            means = torch.where((reached & ~filled)[:, None], more, means)
            filled = filled | reached
        means = means.view(camera.height, camera.width, 5)
        alpha = means[..., 3]
        directions, normal = camera.rays().directions.view(*alpha.shape, 3), None
        if ctx.geometry:
            normal = normals_from_depth(means[..., 4].detach(), alpha.detach() >= MIN_SURFACE_ALPHA, directions.detach())
        far = torch.full_like(alpha, torch.inf)
        return to_rendering(means[..., :3], alpha, means[..., 4] * alpha, normal, far, directions), Trace(rays=alpha.numel())

    def _warp(self, view: View, camera: Camera) -> tuple[Float[Tensor, "p 5"], Bool[Tensor, " p"]]:
        """Mean premultiplied colour, alpha, distance of a photograph's nearest surface in each pixel, and where it is."""
        pixel, weight, distance, values = _splat(view, camera)
        count = camera.width * camera.height
        kept = distance.detach() <= _first(pixel, weight, distance, count)[pixel] * (1 + self.config.tolerance)
        weighted = torch.cat([values, distance[:, None], torch.ones_like(distance)[:, None]], dim=1) * (weight * kept)[:, None]
        sums = weighted.new_zeros(count, 6).index_add(0, pixel, weighted)
        return sums[:, :5] / sums[:, 5:].clamp_min(1e-12), sums[:, 5].detach() > 0


@torch.no_grad()
def _first(
    pixel: Int[Tensor, " n"], weight: Float[Tensor, " n"], distance: Float[Tensor, " n"], count: int
) -> Float[Tensor, " p"]:
    """Distance of the nearest point that occludes each pixel; of the nearest one at all where none does."""
    empty = torch.full((count,), torch.inf, dtype=distance.dtype, device=distance.device)
    solid = weight >= OCCLUDES
    first = empty.scatter_reduce(0, pixel[solid], distance[solid], "amin")
    return torch.where(first.isfinite(), first, empty.scatter_reduce(0, pixel, distance, "amin"))


def _splat(
    view: View, camera: Camera
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, "n 4"]]:
    """Warp a photograph's pixels: target pixels that each touches, weights, distances from ``camera``, premultiplied RGBA."""
    assert view.depth is not None
    depth = view.depth.reshape(-1)
    hit = depth.isfinite().nonzero()[:, 0]
    rays = view.camera.rays()[hit]
    points = rays.origins + depth[hit, None] * rays.directions
    place, z = camera.project(points)
    corner = (place.detach() - 0.5).floor()
    distance = (points - camera.position).norm(dim=1)
    alpha = view.opacity(hit)[:, None]
    values = torch.cat([alpha * view.colour(hit), alpha], dim=1)
    parts = []
    for offset in ((0, 0), (1, 0), (0, 1), (1, 1)):
        target = corner + corner.new_tensor(offset)
        weight = (1 - (place - 0.5 - target).abs()).prod(dim=1)
        limit = target.new_tensor([camera.width, camera.height])
        inside = (z > 0) & ((target >= 0) & (target < limit)).all(dim=1) & (weight > LEAST_COVER)
        pixel = (target[:, 1] * camera.width + target[:, 0]).long()
        parts.append((pixel[inside], weight[inside], distance[inside], values[inside]))
    pixel, weight, distance, values = (torch.cat(column) for column in zip(*parts, strict=True))
    return pixel, weight, distance, values
