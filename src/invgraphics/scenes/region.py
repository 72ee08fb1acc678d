"""Region that photographs show, estimated from their cameras and from known surface points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera

PARALLEL = 0.01
"""Mean squared sine of the angle between viewing directions (6°) below which they have no common focus."""
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


def common_focus(poses: Float[Tensor, "n 4 4"]) -> Float[Tensor, 3] | None:
    """Point closest to all optical axes, in least squares; ``None`` where they are too parallel to have one.

    Args:
        poses: camera-to-world.
    """
    position, forward = poses[:, :3, 3], poses[:, :3, 2]
    # Sum of the projections onto the planes across the axes: its solution is the point closest to all of them.
    across = torch.eye(3, dtype=poses.dtype) - forward[:, :, None] * forward[:, None, :]
    normal_matrix = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(normal_matrix)[0]) < PARALLEL:
        return None
    return torch.linalg.solve(normal_matrix, (across @ position[:, :, None]).mean(dim=0)[:, 0])


def pictured_ball(cameras: Sequence[Camera]) -> tuple[Float[Tensor, 3], float] | None:
    """Centre and radius of the ball around the cameras' common focus that their pictures just hold, in the median.

    Args:
        cameras: float64.

    Returns:
        ``None`` where most cameras do not look at a common focus.
    """
    poses = torch.stack([camera.cam_to_world for camera in cameras])
    focus = common_focus(poses)
    if focus is None:
        return None
    offset = focus - poses[:, :3, 3]
    if float((offset * poses[:, :3, 2]).sum(dim=1).median()) <= 0:
        return None
    half_view = torch.stack([max(camera.width, camera.height) / 2 / camera.focal.min() for camera in cameras])
    return focus, float((offset.norm(dim=1) * half_view).median())


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
