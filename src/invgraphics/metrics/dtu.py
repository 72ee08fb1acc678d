"""DTU's rule for reconstructed surfaces (Jensen et al. 2014; Aanæs et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Mesh
from invgraphics.core.mesh import face_normals
from invgraphics.core.scan import Scan
from invgraphics.metrics.surfaces import sample_surface

SPACING = 0.2
"""Distance to which predicted points are thinned, mm."""
FARTHEST = 20.0
"""Distances beyond this are outliers and do not count, mm."""
DENSITY = 2 / SPACING**2
"""Random points per mm² of the predicted surface, before they are thinned."""
CHUNK = 2_000_000
"""Points that are drawn and thinned at a time."""
MOST_POINTS = 50 * CHUNK
"""Points that are drawn at most; of surfaces of more than two square metres the density is lower, and is stated."""


@dataclass(frozen=True)
class DtuScore:
    """Mean distances in mm, outliers left out.

    Attributes:
        accuracy: of predicted points in observed space to the scan.
        completeness: of the scan's points above the table to the prediction.
        density: random points per mm² of the prediction, before thinning: `DENSITY`, or less on a vast surface.
    """

    accuracy: float
    completeness: float
    density: float = DENSITY

    @property
    def overall(self) -> float:
        """Mean of accuracy and completeness, which papers call Chamfer distance."""
        return (self.accuracy + self.completeness) / 2


def dtu_score(mesh: Mesh, scan: Scan, seed: int = 0) -> DtuScore:
    """Score a mesh against a structured-light scan by DTU's rule.

    The mesh becomes points no denser than `SPACING`: random ones, of which one per cube of that edge is kept (DTU's own program
    thins random points by their distances). What lies too far from the scan to count is dropped as it is drawn.

    Args:
        mesh: in the scan's world, mm.
        scan: the reference.
        seed: of the points.

    Raises:
        ValueError: no predicted point lies in observed space, or one of the surfaces is nowhere near the other.
    """
    area = float(face_normals(mesh.vertices.double(), mesh.faces).norm(dim=1).sum()) / 2
    count = min(MOST_POINTS, max(1000, round(DENSITY * area)))
    points = _thinned_samples(mesh, count, scan, torch.Generator().manual_seed(seed))
    seen = points[scan.sees(points)]
    if not len(seen):
        raise ValueError("no point of the predicted surface lies where the scanner looked")
    density = DENSITY if count < MOST_POINTS else count / area
    return DtuScore(_mean_distance(seen, scan.points), _mean_distance(scan.above_table(), points), density)


def _thinned_samples(mesh: Mesh, count: int, scan: Scan, generator: torch.Generator) -> Float[Tensor, "k 3"]:
    """Random points of a mesh, the first in every cube of edge `SPACING`, where they are near enough to the scan to count."""
    margin = FARTHEST + 2 * SPACING  # cubes that the limit cuts are whole
    lo, hi = scan.points.double().amin(dim=0) - margin, scan.points.double().amax(dim=0) + margin
    cells = ((hi - lo) / SPACING).ceil().long() + 2
    keys, points = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3, dtype=torch.float64)
    for start in range(0, count, CHUNK):
        drawn = sample_surface(mesh, min(CHUNK, count - start), generator).position
        drawn = drawn[((drawn >= lo) & (drawn <= hi)).all(dim=1)]
        cube = (drawn / SPACING).floor().long() - (lo / SPACING).floor().long()
        key = (cube[:, 0] * cells[1] + cube[:, 1]) * cells[2] + cube[:, 2]
        keys, points = _first_of_each(torch.cat([keys, key]), torch.cat([points, drawn]))
    return points


def _first_of_each(keys: Int[Tensor, " n"], points: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, " k"], Float[Tensor, "k 3"]]:
    """The first point of each key, in the keys' order."""
    ordered, order = keys.sort(stable=True)
    first = torch.ones(len(keys), dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return ordered[first], points[order[first]]


def _mean_distance(points: Float[Tensor, "n 3"], to: Float[Tensor, "m 3"]) -> float:
    """Mean distance to the nearest of other points, without those beyond `FARTHEST`."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(to.double().numpy()).query(points.double().numpy(), distance_upper_bound=FARTHEST)
    near = distance[distance < FARTHEST]
    if not len(near):
        raise ValueError(f"the surfaces are nowhere within {FARTHEST:g} mm of each other")
    return float(near.mean())
