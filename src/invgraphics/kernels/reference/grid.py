"""Trilinear interpolation in a dense grid, plain torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding


@dataclass(frozen=True, eq=False)
class Cell:
    """The cell around each of m positions, and where in it the position lies.

    Attributes:
        vertices: integer coordinates of the cell's 8 corners; x varies fastest.
        fraction: position within the cell, in [0, 1].
        corners: the corners' offsets, 0 or 1.
    """

    vertices: Int[Tensor, "m 8 3"]
    fraction: Float[Tensor, "m 3"]
    corners: Int[Tensor, "8 3"]

    @property
    def factors(self) -> Float[Tensor, "m 8 3"]:
        """Each axis's share of a corner's weight: the fraction at the upper corner, its complement at the lower one."""
        fraction = self.fraction[:, None, :]
        return torch.where(self.corners == 1, fraction, 1 - fraction)

    @property
    def weights(self) -> Float[Tensor, "m 8"]:
        """Trilinear weights; they sum to one."""
        x, y, z = self.factors.unbind(-1)
        return x * y * z

    @property
    def slopes(self) -> Float[Tensor, "m 8 3"]:
        """Derivatives of the weights with respect to ``fraction``."""
        x, y, z = self.factors.unbind(-1)
        sign = (2 * self.corners - 1).to(self.fraction.dtype)
        return torch.stack([y * z, x * z, x * y], dim=-1) * sign


def locate(unit: Float[Tensor, "m 3"], cells: Int[Tensor, " 3"]) -> Cell:
    """The cells that hold ``unit`` in a grid of ``cells`` cells per axis; positions outside [0, 1] are clamped."""
    position = unit.clamp(0, 1) * cells
    # The last vertex belongs to the last cell, so that it needs no neighbour beyond.
    lower = torch.minimum(position.detach().floor().long(), (cells - 1).clamp_min(0))
    bits = torch.arange(8, device=unit.device)
    corners = torch.stack([bits & 1, (bits >> 1) & 1, (bits >> 2) & 1], dim=1)
    vertices = torch.minimum(lower[:, None, :] + corners, cells)
    return Cell(vertices, position - lower, corners)


def grid_sample(unit: Float[Tensor, "m 3"], grid: Float[Tensor, "x y z c"]) -> Float[Tensor, "m c"]:
    """See `invgraphics.kernels.grid_sample`."""
    size = torch.tensor(grid.shape[:3], device=unit.device)
    cell = locate(unit, size - 1)
    x, y, z = cell.vertices.unbind(-1)
    index = (x * size[1] + y) * size[2] + z
    # `embedding` rather than indexing: its backward sums in a fixed order, whatever the number of threads.
    values = embedding(index, grid.reshape(-1, grid.shape[3]))
    return torch.einsum("mk,mkc->mc", cell.weights, values)
