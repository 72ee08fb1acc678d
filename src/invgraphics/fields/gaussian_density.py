"""3D Gaussians as one density in space: pointwise density, mixed colour and normal at samples.

The density is the ``physical`` reading of the opacities (`kernels.extinction`), of which `gaussian-volume/exact` with
``opacity = "physical"`` has the line integrals: quadrature converges to it as its steps shrink.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, sqrt

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import harmonics
from invgraphics.core.field import Gaussians, Quantity
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.extinction import SMALLEST_DEPTH, reach, strength

ENTRIES_PER_GAUSSIAN = 24
"""Most entries of the cell lists for each Gaussian, on average; larger cells have fewer entries and more misses."""
FINEST = 128
"""Cells along the longest edge of the Gaussians' bounding box, at most."""
MOST_CANDIDATES = 1 << 21
"""Pairs of samples and Gaussians that are tested at once."""


def query_density(gaussians: Gaussians, samples: Samples, want: Quantity, smallest: float = SMALLEST_DEPTH) -> FieldValues:
    """Sum the densities of the Gaussians at samples, and mix their colours and normals in proportion.

    Differentiable in Gaussians and samples. Nothing is nearer than a Gaussian's reach at most samples of a ray: their density,
    radiance and normal are zero.

    Args:
        gaussians: activated primitives.
        samples: m of them; a Gaussian's colour is that towards the origin of the sample's ray, for a lone point the one along
            its direction.
        want: of density, radiance and normal.
        smallest: optical depth of a line below which a Gaussian is left out, as in the renderers of Gaussians.
    """
    sample, gaussian = overlapping_pairs(gaussians, samples.position.detach(), smallest)
    whitening = quaternion_to_matrix(gaussians.quaternions).transpose(1, 2) / gaussians.scales[:, :, None]
    peak = strength(gaussians, "physical") / sqrt(2 * pi)
    table = torch.cat([gaussians.means, whitening.flatten(1), peak[:, None]], dim=1)
    means, axes, peaks = table.index_select(0, gaussian).split([3, 9, 1], dim=1)
    offset = samples.position.index_select(0, sample) - means
    axes = axes.view(-1, 3, 3)
    x = (axes * offset[:, None, :]).sum(dim=-1)
    density = peaks[:, 0] * torch.exp(-0.5 * x.square().sum(dim=1))
    columns = [density[:, None]]
    if Quantity.RADIANCE in want:
        columns.append(density[:, None] * _colours(gaussians.sh.index_select(0, gaussian), means, samples, sample))
    if Quantity.NORMAL in want:
        columns.append(density[:, None] * (axes * x[:, :, None]).sum(dim=1))
    joined = torch.cat(columns, dim=1)
    sums = joined.new_zeros(len(samples), joined.shape[1]).index_add(0, sample, joined)
    total = sums[:, 0]
    radiance = normal = None
    if Quantity.RADIANCE in want:
        # Where the density is zero so are all colours.
        radiance = sums[:, 1:4] / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]
    if Quantity.NORMAL in want:
        normal = normalize(sums[:, -3:], dim=1, eps=torch.finfo(total.dtype).tiny)
    return FieldValues(density=total if Quantity.DENSITY in want else None, radiance=radiance, normal=normal)


def _colours(
    sh: Float[Tensor, "p c 3"], means: Float[Tensor, "p 3"], samples: Samples, sample: Int[Tensor, " p"]
) -> Float[Tensor, "p 3"]:
    """Colours of Gaussians towards the origins of the samples' rays, as `gaussian-volume/exact` takes them."""
    if sh.shape[1] == 1:
        return harmonics.colour(sh, means)  # the constant band has no direction
    origins = samples.position - samples.mid[:, None] * samples.direction
    lone = (samples.mid == 0)[:, None].index_select(0, sample)
    towards = torch.where(lone, samples.direction.index_select(0, sample), means - origins.index_select(0, sample))
    return harmonics.colour(sh, normalize(towards, dim=1))


@torch.no_grad()
def overlapping_pairs(
    gaussians: Gaussians, position: Float[Tensor, "m 3"], smallest: float = SMALLEST_DEPTH
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Find pairs of positions and Gaussians within the Gaussians' reach, sorted by position, then by Gaussian."""
    none = torch.zeros(0, dtype=torch.int64, device=position.device)
    if not len(position):
        return none, none
    deviations = reach(gaussians, "physical", smallest)
    rotation = quaternion_to_matrix(gaussians.quaternions)
    # Half the edges of the bounding boxes: deviations times the standard deviations along the local frame's axes.
    half = deviations[:, None] * (rotation * gaussians.scales[:, None, :]).square().sum(dim=2).sqrt()
    lo = (gaussians.means - half).maximum(position.amin(dim=0))
    hi = (gaussians.means + half).minimum(position.amax(dim=0))
    shown = ((deviations > 0) & (lo <= hi).all(dim=1)).nonzero()[:, 0]
    if not len(shown):
        return none, none
    means, limit = gaussians.means[shown], deviations[shown].square()
    whitening = (rotation.transpose(1, 2) / gaussians.scales[:, :, None])[shown]
    found = [(none, none)]
    for sample, index in _CellLists.build(lo[shown], hi[shown]).candidates(position):
        offset = position[sample] - means[index]
        kept = (whitening[index] * offset[:, None, :]).sum(dim=-1).square().sum(dim=1) < limit[index]
        found.append((sample[kept], shown[index[kept]]))
    return torch.cat([sample for sample, _ in found]), torch.cat([gaussian for _, gaussian in found])


@dataclass(frozen=True, eq=False)
class _CellLists:
    """Indices of the boxes that overlap each cell of a uniform grid, concatenated in the order of the cells.

    Attributes:
        origin: lowest corner of the grid.
        edge: of the cubic cells.
        shape: cells along the axes.
        first: of each cell, and the number of all entries.
        entries: indices of boxes.
    """

    origin: Float[Tensor, 3]
    edge: float
    shape: Int[Tensor, 3]
    first: Int[Tensor, " cells_plus_1"]
    entries: Int[Tensor, " e"]

    @staticmethod
    def build(lo: Float[Tensor, "n 3"], hi: Float[Tensor, "n 3"]) -> _CellLists:
        """Build lists for n boxes, with the finest cells that keep the number of entries within `ENTRIES_PER_GAUSSIAN`."""
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
        return _CellLists(origin, edge, shape, first, box[order])

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
