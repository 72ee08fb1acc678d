"""Region of an unbounded scene, estimated from known surface points: extent of the subject, and near distance."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

SUBJECT_SHARE = 0.75
"""Share of the points that counts as the subject; the others are its surroundings, or wrong."""
MARGIN = 1.5
"""Half-edge of the box over the subject's radius."""
SMALLEST = 0.05
"""Least half-edge of the box in local units: the farthest camera is at distance 1."""

NEAREST_SHARE = 0.02
"""Share of a camera's points that may be wrong and nearer than its nearest surface."""
CLEARANCE = 0.7
"""Distance of the first sample over that of the nearest points."""
VIEW_ANGLE = 45.0
"""Degrees from the optical axis within which points count as seen."""
FEWEST = 16
"""Fewer points than this say nothing."""


def subject_half(points: Float[Tensor, "n 3"]) -> float:
    """Half edge of the cube around the origin that holds the subject with a margin, local units, at most 1.

    Args:
        points: surface points, local frame.
    """
    if len(points) < FEWEST:
        return 1.0
    radius = float(points.norm(dim=1).double().quantile(SUBJECT_SHARE))
    return min(max(MARGIN * radius, SMALLEST), 1.0)


def near_plane(poses: Float[Tensor, "k 4 4"], points: Float[Tensor, "n 3"]) -> float | None:
    """Near distance of cameras: a share of the nearest point's distance; ``None`` with too few points.

    Args:
        poses: camera-to-world; ``points`` are in the same frame.
        points: surface points.
    """
    nearest = []
    for pose in poses:
        offset = points - pose[:3, 3]
        distance = offset.norm(dim=1)
        ahead = distance[offset @ pose[:3, 2] > math.cos(math.radians(VIEW_ANGLE)) * distance]
        if len(ahead) >= FEWEST:
            nearest.append(float(torch.quantile(ahead, NEAREST_SHARE)))
    return CLEARANCE * min(nearest) if nearest else None
