"""Dense voxel grids, of one resolution or of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from typing_extensions import override

from invgraphics.core.ngp import MAX_LEVELS, HashGrid
from invgraphics.fields.encodings.hash import INITIAL_RANGE
from invgraphics.fields.encodings.lattices import CUBE, LatticeConfig, LatticeFeatures, Place, vertices_along


@dataclass(frozen=True)
class VoxelsConfig(LatticeConfig):
    """Features at the vertices of dense grids: one (DVGO, Sun et al. 2022), or a hash grid's levels without its collisions.

    Attributes:
        resolution: vertices along an edge of the finest level; in a box of other proportions as many voxels in all.
        features: features per vertex.
        levels: number of resolutions, a geometric progression of cells as in Instant-NGP (§3); their features are concatenated.
        coarsest: vertices along an edge of the coarsest of several levels.
        initial: value at the start (DVGO: 0; the density of Plenoxels: 0.1).
        spread: values start uniformly within this much of ``initial`` (Instant-NGP: 1e-4; DVGO: 0).
    """

    title: ClassVar[str] = "voxel grid"

    resolution: int = 64
    features: int = 4
    levels: int = 1
    coarsest: int = 17
    initial: float = 0.0
    spread: float = INITIAL_RANGE

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.features < 1 or not 1 <= self.levels <= MAX_LEVELS:
            raise ValueError(f"resolution must be at least 2, features at least 1, levels from 1 to {MAX_LEVELS}.")
        if self.levels > 1 and not 2 <= self.coarsest <= self.resolution:
            raise ValueError(f"coarsest must be from 2 to resolution = {self.resolution}, not {self.coarsest}.")
        if self.spread < 0:
            raise ValueError(f"spread must not be negative, not {self.spread}.")

    @override
    def build(self, edges: Sequence[float] = CUBE) -> LatticeFeatures:
        """The encoding for a region with these edges; its parameters are ``levels.0``, ``levels.1``, .., coarse to fine."""
        base = self.resolution if self.levels == 1 else self.coarsest
        cells = HashGrid(levels=self.levels, base=base - 1, finest=self.resolution - 1).resolutions
        grids = {}
        for level, count in enumerate(cells):
            values = torch.empty(*vertices_along(count + 1, edges), self.features)
            grids[Place("levels", str(level), "xyz")] = values.uniform_(self.initial - self.spread, self.initial + self.spread)
        return LatticeFeatures(grids, "concat")
