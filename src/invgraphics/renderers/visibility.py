"""Masks of unit-cube cells: visible in a training view, which no untrained cell is (Instant-NGP), or near known points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core import Bounds, Camera

IMAGE_MARGIN = 0.1
"""Share of the picture's size by which cells may lie outside it: poses are never exact."""


@torch.no_grad()
def visible_cells(bounds: Bounds, resolution: int, cameras: Sequence[Camera]) -> Bool[Tensor, "r r r"]:
    """Mask of cells with a corner or their centre, beyond the near plane, in the picture of at least one camera."""
    seen = _corners(bounds, resolution, 0.0, cameras)
    padded = seen[:-1] | seen[1:]
    padded = padded[:, :-1] | padded[:, 1:]
    seen = (padded[:, :, :-1] | padded[:, :, 1:]) | _corners(bounds, resolution, 0.5, cameras)
    return seen & cells_in_ball(resolution).to(seen.device) if bounds.space == "contracted" else seen


def cells_in_ball(resolution: int) -> Bool[Tensor, "r r r"]:
    """Mask of the unit cube's cells that meet the ball in it, into which endless space is contracted."""
    edges = (torch.arange(resolution + 1) / resolution - 0.5).abs()
    nearest = torch.minimum(edges[:-1], edges[1:]).square()
    return nearest[:, None, None] + nearest[:, None] + nearest <= 0.25


def _corners(bounds: Bounds, resolution: int, offset: float, cameras: Sequence[Camera]) -> Bool[Tensor, "k k k"]:
    """Mask of lattice points in any picture: cell corners for ``offset`` 0, centres for 0.5."""
    count = resolution if offset else resolution + 1
    axis = (torch.arange(count, dtype=bounds.lo.dtype, device=bounds.lo.device) + offset) / resolution
    position = bounds.from_unit(torch.cartesian_prod(axis, axis, axis))
    seen = torch.zeros(len(position), dtype=torch.bool, device=position.device)
    for camera in cameras:
        at = camera.to(position.dtype).to(position.device)
        pixel, depth = at.project(position)
        size = pixel.new_tensor([camera.width, camera.height])
        inside = ((pixel >= -IMAGE_MARGIN * size) & (pixel <= (1 + IMAGE_MARGIN) * size)).all(dim=1)
        seen |= inside & (depth > 0) & ((position - at.position).norm(dim=1) >= bounds.near)
    return seen.view(count, count, count)


def flat_cells(mask: Bool[Tensor, "r r r"] | None, grid: Tensor) -> Int[Tensor, " k"]:
    """Flat indices of the cells of ``mask``; of all cells of ``grid`` where there is no mask, or nothing in it."""
    found = None if mask is None else torch.nonzero(mask.flatten())[:, 0]
    return torch.arange(grid.numel(), device=grid.device) if found is None or len(found) == 0 else found


@torch.no_grad()
def cells_near_points(bounds: Bounds, resolution: int, points: Float[Tensor, "n 3"], reach: int) -> Bool[Tensor, "r r r"]:
    """Mask of cells at most ``reach`` cells along each axis from a cell with a point in it."""
    cell = (bounds.to_unit(points.to(bounds.lo)) * resolution).floor().long()
    cell = cell[((cell >= 0) & (cell < resolution)).all(dim=1)]
    hit = torch.zeros((resolution,) * 3, device=cell.device)
    hit[tuple(cell.T)] = 1.0
    width = 2 * reach + 1
    return torch.nn.functional.max_pool3d(hit[None, None], width, stride=1, padding=reach)[0, 0] > 0
