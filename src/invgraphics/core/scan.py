"""A reference surface measured by a scanner."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of a structured-light scan, and where it can be compared with, in the data set's world (DTU: millimetres).

    Attributes:
        points: on the surface.
        observed: voxels in which the scanner would have seen a surface; ``None`` where that is not known.
        origin: centre of the first voxel.
        voxel: distance between voxels' centres.
        plane: (a, b, c, d) of the table's plane: points count where a x + b y + c z + d > 0; ``None`` for all.
    """

    points: Float[Tensor, "n 3"]
    observed: Bool[Tensor, "x y z"] | None = None
    origin: Float[Tensor, 3] | None = None
    voxel: float = 1.0
    plane: Float[Tensor, 4] | None = None

    def sees(self, points: Float[Tensor, "m 3"]) -> Bool[Tensor, " m"]:
        """Which points lie in an observed voxel; all, where the observed ones are not known."""
        if self.observed is None or self.origin is None:
            return torch.ones(len(points), dtype=torch.bool)
        index = ((points - self.origin) / self.voxel).round().long()
        shape = torch.tensor(self.observed.shape)
        inside = (index >= 0).all(dim=1) & (index < shape).all(dim=1)
        x, y, z = index.clamp(torch.zeros(3).long(), shape - 1).unbind(dim=1)
        return inside & self.observed[x, y, z]

    def above_table(self) -> Float[Tensor, "k 3"]:
        """The points that completeness counts: those above the plane."""
        if self.plane is None:
            return self.points
        return self.points[self.points @ self.plane[:3] + self.plane[3] > 0]
