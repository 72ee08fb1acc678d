"""Multilinear interpolation on lattices and combinations of it, plain torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding

from invgraphics.core.lattice import Combination, Lattice


@dataclass(frozen=True, eq=False)
class Cell:
    """The d-dimensional cell around each of m positions, and where in it the position lies.

    Attributes:
        vertices: integer coordinates of the cell's k = 2^d corners; the first axis varies fastest.
        fraction: position within the cell, in [0, 1].
        corners: the corners' offsets, 0 or 1.
    """

    vertices: Int[Tensor, "m k d"]
    fraction: Float[Tensor, "m d"]
    corners: Int[Tensor, "k d"]

    @property
    def factors(self) -> Float[Tensor, "m k d"]:
        """Each axis's share of a corner's weight: the fraction at the upper corner, its complement at the lower one."""
        fraction = self.fraction[:, None, :]
        return torch.where(self.corners == 1, fraction, 1 - fraction)

    @property
    def weights(self) -> Float[Tensor, "m k"]:
        """Multilinear weights; they sum to one."""
        return math.prod(self.factors.unbind(-1), start=torch.ones_like(self.fraction[:, :1]))

    @property
    def slopes(self) -> Float[Tensor, "m k d"]:
        """Derivatives of the weights with respect to ``fraction``: products of the other axes' factors."""
        factors, one = self.factors.unbind(-1), torch.ones_like(self.factors[..., 0])
        others = [math.prod((f for b, f in enumerate(factors) if b != a), start=one) for a in range(len(factors))]
        return torch.stack(others, dim=-1) * (2 * self.corners - 1).to(self.fraction.dtype)


def locate(unit: Float[Tensor, "m d"], cells: Int[Tensor, " d"]) -> Cell:
    """The cells that hold ``unit`` in a grid of ``cells`` cells per axis; positions are clamped to [0, 1], NaN counts as 0."""
    position = unit.nan_to_num(0.0).clamp(0, 1) * cells
    # The last vertex belongs to the last cell, so that it needs no neighbour beyond.
    lower = torch.minimum(position.detach().floor().long(), (cells - 1).clamp_min(0))
    axes = torch.arange(unit.shape[1], device=unit.device)
    corners = (torch.arange(2 ** len(axes), device=unit.device)[:, None] >> axes) & 1
    vertices = torch.minimum(lower[:, None, :] + corners, cells)
    return Cell(vertices, position - lower, corners)


def interpolate(unit: Float[Tensor, "m 3"], lattice: Lattice) -> Float[Tensor, "m c"]:
    """Linear, bilinear or trilinear interpolation of one lattice's features."""
    size = torch.tensor(lattice.resolution, device=unit.device)
    cell = locate(torch.stack([unit[:, column] for column in lattice.columns], dim=1), size - 1)
    index = cell.vertices[..., 0]
    for axis in range(1, len(size)):
        index = index * size[axis] + cell.vertices[..., axis]
    rows, weights = lattice.rows, cell.weights
    if lattice.links is not None:
        index = lattice.links.reshape(-1)[index].long()
        linked = (index >= 0) & (index < len(rows))
        # An empty vertex reads a row of zeros behind all others.
        rows, index = torch.cat([rows, rows.new_zeros(1, lattice.channels)]), torch.where(linked, index, len(rows))
    # `embedding` rather than indexing: its backward sums in a fixed order, whatever the number of threads. Of no points it has
    # no second derivative.
    values = embedding(index, rows) if len(unit) else rows[index]
    return torch.einsum("mk,mkc->mc", weights, values)


def lattice_encode(
    unit: Float[Tensor, "m 3"],
    lattices: Sequence[Lattice],
    combine: Combination = "concat",
    sparse_gradients: bool = False,
) -> Float[Tensor, "m width"]:
    """See `invgraphics.kernels.lattice_encode`; gradients are dense."""
    return combine_features([interpolate(unit, lattice) for lattice in lattices], combine)


def combine_features(values: Sequence[Float[Tensor, "m c"]], combine: Combination) -> Float[Tensor, "m width"]:
    """Combine the features of several lattices (see `core.lattice.Combination`)."""
    match combine:
        case "concat":
            return torch.cat(list(values), dim=1)
        case "sum":
            return torch.stack(list(values)).sum(0)
        case "vm":
            return torch.cat([plane * line for plane, line in zip(values[::2], values[1::2], strict=True)], dim=1)
        case "cp":
            return math.prod(values[1:], start=values[0])
