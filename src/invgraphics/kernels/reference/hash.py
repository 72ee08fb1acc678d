"""Multi-resolution hash encoding (Instant-NGP, §3), plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding

from invgraphics.core.ngp import HashGrid
from invgraphics.kernels.reference.lattice import locate

PRIMES = (1, 2654435761, 805459861)
"""Factors of the spatial hash, one per axis (Instant-NGP, equation 4)."""


def entry_index(vertices: Int[Tensor, "*m 3"], resolution: int, log2_size: int) -> Int[Tensor, "*m"]:
    """Entry of a level's table that a vertex reads.

    Vertices are stored densely, x fastest, where all of them fit; otherwise
    ``(x * 1 ^ y * 2654435761 ^ z * 805459861) mod 2**log2_size`` in unsigned 32-bit arithmetic.

    Args:
        vertices: integer coordinates 0 to ``resolution``.
        resolution: cells along an edge.
        log2_size: most entries of a level, as a power of two.
    """
    x, y, z = vertices.unbind(-1)
    edge = resolution + 1
    if edge**3 <= 2**log2_size:
        return x + edge * (y + edge * z)
    # Only the low bits count, and they do not depend on where the words wrap around: 64-bit products serve as well.
    hashed = (x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])
    return hashed & (2**log2_size - 1)


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """See `invgraphics.kernels.hash_encode`. Positions outside [0, 1] are clamped, and their Jacobian is zero there."""
    inside = ((unit >= 0) & (unit <= 1)).to(unit.dtype)
    features, slopes = [], []
    for resolution, level in zip(grid.resolutions, table.split(list(grid.sizes)), strict=True):
        cell = locate(unit, torch.tensor([resolution] * 3, device=unit.device))
        index = entry_index(cell.vertices, resolution, grid.log2_size)
        # `embedding` rather than indexing: its backward sums in a fixed order, whatever the number of threads.
        entries = embedding(index, level)
        features.append(torch.einsum("mk,mkf->mf", cell.weights, entries))
        if jacobian:
            slope = torch.einsum("mka,mkf->mfa", cell.slopes, entries)
            slopes.append(slope * (resolution * inside)[:, None, :])
    return torch.cat(features, dim=1), torch.cat(slopes, dim=1) if jacobian else None
