"""Accuracy, completeness and Chamfer distance between surfaces, from points sampled on them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SurfaceDistance:
    """Mean distances between points of two surfaces, in their units.

    Attributes:
        accuracy: mean distance from predicted points to the true surface.
        completeness: mean distance from true points to the predicted surface.
    """

    accuracy: float
    completeness: float

    @property
    def chamfer(self) -> float:
        """Chamfer distance: mean of accuracy and completeness (not squared)."""
        return (self.accuracy + self.completeness) / 2


def surface_distance(
    predicted: Float[Tensor, "n 3"], true: Float[Tensor, "m 3"], required: Float[Tensor, "k 3"] | None = None
) -> SurfaceDistance:
    """Compare points sampled on two surfaces by nearest neighbours.

    Args:
        predicted: points of the prediction.
        true: points of the truth, all of it.
        required: points of the truth that completeness counts, for instance those in view; ``None`` for all.
    """
    from scipy.spatial import KDTree

    required = true if required is None else required
    ours, theirs, counted = (points.double().cpu().numpy() for points in (predicted, true, required))
    accuracy, _ = KDTree(theirs).query(ours)
    completeness, _ = KDTree(ours).query(counted)
    return SurfaceDistance(float(accuracy.mean()), float(completeness.mean()))


def points_on(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int, generator: torch.Generator
) -> Float[Tensor, "count 3"]:
    """Uniform random points on a triangle mesh.

    Args:
        vertices: positions.
        faces: corners; triangles are drawn by area.
        count: points wanted.
        generator: source of randomness.
    """
    a, b, c = vertices.double()[faces].unbind(dim=1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    # torch.multinomial takes at most 2^24 classes.
    cumulative = area.cumsum(0)
    chosen = torch.searchsorted(cumulative, torch.rand(count, generator=generator, dtype=torch.float64) * cumulative[-1])
    chosen = chosen.clamp_max(len(faces) - 1)
    u, v = torch.rand(2, count, 1, generator=generator, dtype=torch.float64)
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    return (a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]).to(vertices.dtype)
