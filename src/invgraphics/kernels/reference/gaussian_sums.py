"""Sums of overlapping Gaussian densities at points, by cell lists of the Gaussians' bounding boxes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, sqrt

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import harmonics
from invgraphics.core.field import Gaussians
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.extinction import SMALLEST_DEPTH, reach, strength

ENTRIES_PER_GAUSSIAN = 24
"""Most entries of the cell lists for each Gaussian, on average; larger cells have fewer entries and more misses."""
FINEST = 128
"""Cells along the longest edge of the Gaussians' bounding box, at most."""
MOST_CANDIDATES = 1 << 21
"""Pairs of samples and Gaussians that are tested at once."""


def density_table(gaussians: Gaussians) -> Float[Tensor, "n 13"]:
    """Rows of Gaussians: centre, whitening transform diag(1/s) Rᵀ, and largest density of the ``physical`` reading."""
    whitening = quaternion_to_matrix(gaussians.quaternions).transpose(1, 2) / gaussians.scales[:, :, None]
    peak = strength(gaussians, "physical") / sqrt(2 * pi)
    return torch.cat([gaussians.means, whitening.flatten(1), peak[:, None]], dim=1)


def gaussian_density(
    gaussians: Gaussians, position: Float[Tensor, "m 3"], eye: Float[Tensor, "m 3"] | None, smallest: float = SMALLEST_DEPTH
) -> Float[Tensor, "m c"]:
    """See `invgraphics.kernels.gaussians.gaussian_density`."""
    sample, gaussian = overlapping_pairs(gaussians, position.detach(), smallest)
    means, axes, peaks = density_table(gaussians).index_select(0, gaussian).split([3, 9, 1], dim=1)
    offset = position.index_select(0, sample) - means
    x = (axes.view(-1, 3, 3) * offset[:, None, :]).sum(dim=-1)
    density = peaks * torch.exp(-0.5 * x.square().sum(dim=1, keepdim=True))
    columns = [density]
    if eye is not None:
        towards = normalize(means - eye.index_select(0, sample), dim=1)
        columns.append(density * harmonics.colour(gaussians.sh.index_select(0, gaussian), towards))
    joined = torch.cat(columns, dim=1)
    return joined.new_zeros(len(position), joined.shape[1]).index_add(0, sample, joined)


@torch.no_grad()
def overlapping_pairs(
    gaussians: Gaussians, position: Float[Tensor, "m 3"], smallest: float = SMALLEST_DEPTH
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Find pairs of positions and Gaussians within the Gaussians' reach, sorted by position, then by Gaussian."""
    none = torch.zeros(0, dtype=torch.int64, device=position.device)
    lists = cell_lists(gaussians, position, smallest)
    if lists is None:
        return none, none
    whitening = quaternion_to_matrix(gaussians.quaternions).transpose(1, 2) / gaussians.scales[:, :, None]
    limit = reach(gaussians, "physical", smallest).square()
    found = [(none, none)]
    for sample, index in lists.candidates(position):
        offset = position[sample] - gaussians.means[index]
        kept = (whitening[index] * offset[:, None, :]).sum(dim=-1).square().sum(dim=1) < limit[index]
        found.append((sample[kept], index[kept]))
    return torch.cat([sample for sample, _ in found]), torch.cat([gaussian for _, gaussian in found])


@torch.no_grad()
def cell_lists(gaussians: Gaussians, position: Float[Tensor, "m 3"], smallest: float) -> CellLists | None:
    """Cell lists of the Gaussians that can reach the bounding box of positions; ``None`` without any."""
    # A position that is not finite is reached by nothing, and would leave no box around the others.
    finite = position.isfinite().all(dim=1)
    position = position if bool(finite.all()) else position[finite]
    if not len(position):
        return None
    deviations = reach(gaussians, "physical", smallest)
    rotation = quaternion_to_matrix(gaussians.quaternions)
    # Half the edges of the bounding boxes: deviations times the standard deviations along the local frame's axes.
    half = deviations[:, None] * (rotation * gaussians.scales[:, None, :]).square().sum(dim=2).sqrt()
    lo = (gaussians.means - half).maximum(position.amin(dim=0))
    hi = (gaussians.means + half).minimum(position.amax(dim=0))
    shown = ((deviations > 0) & (lo <= hi).all(dim=1)).nonzero()[:, 0]
    return CellLists.build(lo[shown], hi[shown], shown) if len(shown) else None


@dataclass(frozen=True, eq=False)
class CellLists:
    """Indices of the boxes that overlap each cell of a uniform grid, concatenated in the order of the cells.

    Attributes:
        origin: lowest corner of the grid.
        edge: of the cubic cells.
        shape: cells along the axes.
        first: of each cell, and the number of all entries.
        entries: names of boxes, rising within a cell.
    """

    origin: Float[Tensor, 3]
    edge: float
    shape: Int[Tensor, 3]
    first: Int[Tensor, " cells_plus_1"]
    entries: Int[Tensor, " e"]

    @staticmethod
    def build(lo: Float[Tensor, "n 3"], hi: Float[Tensor, "n 3"], names: Int[Tensor, " n"]) -> CellLists:
        """Build lists for n named boxes, with the finest cells that keep entries within `ENTRIES_PER_GAUSSIAN`."""
        origin = lo.amin(dim=0)
        size = hi.amax(dim=0) - origin
        edge = max(float(size.max()) / FINEST, 1e-12)  # all positions may be one point
        while True:
            begin, end = ((corner - origin).div(edge).long() for corner in (lo, hi))
            spans = end - begin + 1
            counts = spans.prod(dim=1)
            if int(counts.sum()) <= ENTRIES_PER_GAUSSIAN * len(lo):
                break
            edge *= 1.5
        shape = size.div(edge).long() + 1
        box = torch.arange(len(lo), device=lo.device).repeat_interleave(counts)
        within = torch.arange(len(box), device=lo.device) - (counts.cumsum(0) - counts)[box]
        y, z = spans[box, 1], spans[box, 2]
        cell = begin[box] + torch.stack([within // (y * z), within // z % y, within % z], dim=1)
        flat, order = _flat(cell, shape).sort(stable=True)
        first = torch.searchsorted(flat, torch.arange(int(shape.prod()) + 1, device=lo.device))
        return CellLists(origin, edge, shape, first, names[box[order]])

    def candidates(self, position: Float[Tensor, "m 3"]) -> Iterator[tuple[Int[Tensor, " p"], Int[Tensor, " p"]]]:
        """Generate pairs of positions and boxes that share a cell, at most about `MOST_CANDIDATES` at once, by position."""
        cell = (position - self.origin).div(self.edge).floor()
        inside = ((cell >= 0) & (cell < self.shape)).all(dim=1).nonzero()[:, 0]
        flat = _flat(cell[inside].long(), self.shape)
        begin, counts = self.first[flat], self.first[flat + 1] - self.first[flat]
        part = counts.cumsum(0) // MOST_CANDIDATES
        for size in torch.bincount(part).tolist() if len(part) else ():
            own, inside = inside[:size], inside[size:]
            at, begin = begin[:size], begin[size:]
            count, counts = counts[:size], counts[size:]
            index = torch.arange(size, device=own.device).repeat_interleave(count)
            within = torch.arange(len(index), device=own.device) - (count.cumsum(0) - count)[index]
            yield own[index], self.entries[at[index] + within]


def _flat(cell: Int[Tensor, "k 3"], shape: Int[Tensor, 3]) -> Int[Tensor, " k"]:
    return (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
