"""Resolution of photographs in space: the size of a pixel at points and over a region."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera

CHUNK = 1 << 15
"""Points whose distances to all cameras are held at once."""


def pixel_sizes(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Size of a pixel at each point, local units: the smallest distance over focal length of any camera, in view or not.

    A lower bound of what any of the cameras can resolve there, from distances alone.
    """
    position = torch.stack([camera.position for camera in cameras]).to(points)
    focal = torch.stack([camera.focal.max() for camera in cameras]).to(points)
    sizes = [_nearest(part, position, focal) for part in points.split(CHUNK)]
    return torch.cat(sizes) if sizes else points[:, 0]


def _nearest(points: Float[Tensor, "k 3"], position: Float[Tensor, "c 3"], focal: Float[Tensor, " c"]) -> Float[Tensor, " k"]:
    """Smallest distance over focal length, by |p - c|² = |p|² - 2 p·c + |c|²."""
    squared = points.square().sum(dim=1, keepdim=True) - 2 * points @ position.T + position.square().sum(dim=1)
    return (squared.clamp_min(0.0) / focal.square()).amin(dim=1).sqrt()


def pixel_size(bounds: Bounds, cameras: Sequence[Camera]) -> float:
    """Median over the bounds' box of `pixel_sizes`, local units."""
    axis = torch.linspace(-1, 1, 8)
    points = bounds.centre + torch.cartesian_prod(axis, axis, axis).to(bounds.half) * bounds.half
    return float(pixel_sizes(points, cameras).median())


def pixel_limit(bounds: Bounds, cameras: Sequence[Camera]) -> float:
    """Vertices along the edge of a cubic lattice that are a `pixel_size` apart.

    In contracted space the box has half of the lattice's edge.
    """
    edge = float((2 * bounds.half).prod()) ** (1 / 3) * (2 if bounds.space == "contracted" else 1)
    return edge / pixel_size(bounds, cameras)
