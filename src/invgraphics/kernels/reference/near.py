"""Nearest points within a radius, by brute force."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

MOST_DISTANCES = 1 << 22
"""Distances that are in memory at once."""


@torch.no_grad()
def near_points(
    position: Float[Tensor, "m 3"], points: Float[Tensor, "n 3"], count: int, radius: float
) -> tuple[Int[Tensor, "m count"], Float[Tensor, "m count"]]:
    """See `invgraphics.kernels.near_points`."""
    index = torch.full((len(position), count), -1, dtype=torch.int64, device=position.device)
    squared = torch.full((len(position), count), torch.inf, dtype=position.dtype, device=position.device)
    k = min(count, len(points))
    if k == 0:
        return index, squared
    rows = max(1, MOST_DISTANCES // len(points))
    for first in range(0, len(position), rows):
        part = slice(first, first + rows)
        distance = (position[part, None] - points).square().sum(dim=2)
        # Stable, so that the lower index comes first among equals.
        nearest, order = distance.sort(dim=1, stable=True)
        near = nearest[:, :k] <= radius * radius
        index[part, :k] = torch.where(near, order[:, :k], -1)
        squared[part, :k] = torch.where(near, nearest[:, :k], torch.inf)
    return index, squared
