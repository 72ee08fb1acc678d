"""DTU's rule for reconstructed surfaces (Jensen et al. 2014; Aanæs et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Mesh
from invgraphics.core.mesh import face_normals
from invgraphics.core.scan import Scan
from invgraphics.metrics.surfaces import sample_surface

SPACING = 0.2
"""Distance to which predicted points are thinned, mm."""
FARTHEST = 20.0
"""Distances beyond this are outliers and do not count, mm."""
MOST_POINTS = 2_000_000


@dataclass(frozen=True)
class DtuScore:
    """Mean distances in mm, outliers left out.

    Attributes:
        accuracy: of predicted points in observed space to the scan.
        completeness: of the scan's points above the table to the prediction.
    """

    accuracy: float
    completeness: float

    @property
    def overall(self) -> float:
        """Mean of accuracy and completeness, which papers call Chamfer distance."""
        return (self.accuracy + self.completeness) / 2


def dtu_score(mesh: Mesh, scan: Scan, seed: int = 0) -> DtuScore:
    """Score a mesh against a structured-light scan by DTU's rule.

    The mesh becomes points no denser than `SPACING`: random ones, of which one per cube of that edge is kept (DTU's own program
    thins random points by their distances).

    Args:
        mesh: in the scan's world, mm.
        scan: the reference.
        seed: of the points.

    Raises:
        ValueError: no predicted point lies in observed space, or one of the surfaces is nowhere near the other.
    """
    area = float(face_normals(mesh.vertices.double(), mesh.faces).norm(dim=1).sum()) / 2
    count = min(MOST_POINTS, max(1000, round(2 * area / SPACING**2)))
    points = _thinned(sample_surface(mesh, count, torch.Generator().manual_seed(seed)).position)
    seen = points[scan.sees(points)]
    if not len(seen):
        raise ValueError("no point of the predicted surface lies where the scanner looked")
    return DtuScore(_mean_distance(seen, scan.points), _mean_distance(scan.above_table(), points))


def _thinned(points: Float[Tensor, "n 3"]) -> Float[Tensor, "k 3"]:
    """The first point in every cube of edge `SPACING`."""
    cubes, cube = torch.unique((points / SPACING).floor().long(), dim=0, return_inverse=True)
    first = torch.full((len(cubes),), len(points)).scatter_reduce(0, cube, torch.arange(len(points)), "amin")
    return points[first]


def _mean_distance(points: Float[Tensor, "n 3"], to: Float[Tensor, "m 3"]) -> float:
    """Mean distance to the nearest of other points, without those beyond `FARTHEST`."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(to.double().numpy()).query(points.double().numpy(), distance_upper_bound=FARTHEST)
    near = distance[distance < FARTHEST]
    if not len(near):
        raise ValueError(f"the surfaces are nowhere within {FARTHEST:g} mm of each other")
    return float(near.mean())
