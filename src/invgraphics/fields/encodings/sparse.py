"""Sparse voxel grids: features of the vertices that are kept only (Plenoxels, Fridovich-Keil et al. 2022, §3.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core.field import Encoding, resize_to_stored
from invgraphics.core.lattice import CORNER, ORIGIN, Combination, Lattice, resampled, vertices_along
from invgraphics.errors import InputError
from invgraphics.fields.encodings.lattices import CUBE, LatticeConfig

LOOKUPS = 1 << 18
"""Vertices that a resized grid looks up at once."""


@dataclass(frozen=True)
class SparseVoxelsConfig(LatticeConfig):
    """Features at the kept vertices of one grid: at first all, until a hook prunes them.

    Attributes:
        resolution: vertices along an edge; in a box of other proportions as many voxels in all.
        features: features per vertex.
        initial: value at the start (Plenoxels: 0.1 for density, 0 for spherical harmonics).
    """

    title: ClassVar[str] = "sparse voxel grid"

    resolution: int = 64
    features: int = 4
    initial: float = 0.0

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.features < 1:
            raise ValueError("resolution must be at least 2, features at least 1.")

    @override
    def build(self, edges: Sequence[float] = CUBE) -> SparseVoxels:
        """The encoding for a region with these edges; its parameter is ``rows``."""
        return SparseVoxels(vertices_along(self.resolution, edges), self.features, self.initial)


class SparseVoxels(Encoding):
    """Trilinear interpolation of rows of features that vertices link to; empty vertices are 0.

    Args:
        resolution: vertices along x, y and z, all of them kept.
        features: per vertex.
        initial: their value.

    Attributes:
        rows: features of the kept vertices, in the order of memory.
        links: row of each vertex, -1 for none.
        sparse_gradients: whether ``rows`` may have a sparse gradient (see `core.lattice.SparseGradientModule`).
    """

    combine: Combination = "concat"
    scale: float = 1.0
    sparse_gradients: bool = False
    rows: Tensor
    links: Tensor

    def __init__(self, resolution: tuple[int, int, int], features: int, initial: float) -> None:
        super().__init__()
        count = math.prod(resolution)
        self.width = features
        self.rows = nn.Parameter(torch.full((count, features), initial))
        self.register_buffer("links", torch.arange(count, dtype=torch.int32).reshape(resolution))

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Vertices along x, y and z, kept or not."""
        x, y, z = self.links.shape
        return x, y, z

    def lattices(self) -> tuple[Lattice, ...]:
        """The one linked lattice."""
        return (Lattice(self.rows, "xyz", self.links),)

    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features at ``unit``, differentiable twice; ``covariance`` is not used."""
        return kernels.lattice_encode(unit, self.lattices(), self.combine, self.sparse_gradients)

    @torch.no_grad()
    def keep(self, kept: Bool[Tensor, "x y z"]) -> Int[Tensor, " k"]:
        """Empty all vertices but those ``kept``; returns the old rows of those left. ``rows`` is a new parameter."""
        kept = kept & (self.links >= 0)
        old = self.links[kept].long()
        if len(old) == 0:
            raise InputError("Pruning would leave no voxel.", "Choose a lower threshold, or prune later in the fit.")
        self.rows = nn.Parameter(self.rows[old])
        self._link(kept)
        return old

    @torch.no_grad()
    def resize(self, resolution: tuple[int, int, int], lo: Sequence[float] = ORIGIN, hi: Sequence[float] = CORNER) -> None:
        """Interpolate to other numbers of vertices; those that a kept one reaches are kept.

        With nested vertices (R -> 2R - 1) the function stays the same everywhere.

        Args:
            resolution: vertices along x, y and z, at least 2.
            lo: lowest corner of the part of the unit cube that the new grid spans.
            hi: its highest corner.

        Raises:
            InputError: fewer than 2 vertices, or none that is kept.
        """
        if min(resolution) < 2:
            raise InputError(f"A lattice cannot be resized to {resolution} vertices.", "It needs at least 2 along each axis.")
        reached = resampled((self.links >= 0).to(self.rows.dtype)[..., None], resolution, lo, hi)[..., 0] > 0
        if not bool(reached.any()):
            raise InputError("A sparse grid cannot be resized to where it keeps no voxel.")
        place = torch.nonzero(reached)
        first, last = (torch.tensor(corner, dtype=torch.float64, device=place.device) for corner in (lo, hi))
        cells = torch.tensor(resolution, device=place.device) - 1
        parts = [
            kernels.lattice_encode((first + (last - first) * part / cells).to(self.rows.dtype), self.lattices(), self.combine)
            for part in place.split(LOOKUPS)
        ]
        self.rows = nn.Parameter(torch.cat(parts))
        self._link(reached)

    def _link(self, kept: Bool[Tensor, "x y z"]) -> None:
        """Link ``kept`` vertices to rows in the order of memory."""
        index = kept.flatten().cumsum(0).reshape(kept.shape) - 1
        self.links = torch.where(kept, index, -1).to(torch.int32)

    @override
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Take the checkpoint's numbers of vertices and rows first, which a fit may have changed."""
        rows, links = (state_dict.get(prefix + name) for name in ("rows", "links"))
        if (
            isinstance(rows, Tensor)
            and isinstance(links, Tensor)
            and rows.shape[-1:] == self.rows.shape[-1:]
            and links.ndim == 3
        ):
            resize_to_stored(self.rows, rows)
            self.links = self.links.new_empty(links.shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
