"""Region that photographs show, from cameras, pictures and known surface points, and the local frame that it gives a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from invgraphics.core import Bounds, Camera, Points
from invgraphics.errors import InputError
from invgraphics.scenes.border import is_object, looked_at
from invgraphics.scenes.pictures.images import Photo, read_pixels

ROUNDING = 1e-9
"""Share of the cameras' distance from the world's origin below which their distances from one another are rounding."""
NEAR = 0.05
"""Closest sample to a camera in local units, where a data set gives none."""

BOX_HALF = 1.5
"""Longest half-edge in local units of a box that is scaled; NeRF-synthetic lies within it (instant-ngp and TensoRF use it)."""
BOX_HALVES = (0.5, 4.0)
"""Longest half-edges of boxes that are taken as they are, up to the same distance from the origin."""

BOX_MARGIN = 1.05
"""Half-edge of an object's box over the radius that its pictures show; NeRF-synthetic has 1.03."""
CONVENTIONAL = (0.67, 2.0)
"""Ratios to that radius within which a format's conventional half-edge is taken instead."""
OFF_CENTRE = 0.5
"""Distance of the pictures' centre from the origin up to which it is, in half-edges."""

PARALLEL = 0.01
"""Mean squared sine of the angle between viewing directions (6°) below which they have no common focus."""
SUBJECT_SHARE = 0.75
"""Share of the points that is the subject; the others are its surroundings, or wrong."""
MARGIN = 1.5
"""Half-edge of the box over the subject's radius."""
SMALLEST = 0.05
"""Least half-edge of the box in local units: the farthest camera is at distance 1."""

NEAREST_SHARE = 0.02
"""Share of a camera's points that may be wrong and nearer than its nearest surface."""
CLEARANCE = 0.7
"""Distance of the first sample over that of the nearest points."""
VIEW_ANGLE = 45.0
"""Degrees from the optical axis within which points are seen."""
FEWEST = 16
"""Fewer points than this are no estimate."""


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """Local frame of a scene, its bounds and known points.

    Attributes:
        bounds: local.
        world_from_local: similarity, float64.
        points: known surface points, world frame.
    """

    bounds: Bounds
    world_from_local: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    points: Points | None = None

    @property
    def scale(self) -> float:
        """World length of one local unit."""
        return float(torch.linalg.det(self.world_from_local[:3, :3]) ** (1 / 3))


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


def ahead_of(poses: Float[Tensor, "n 4 4"], point: Float[Tensor, 3]) -> Float[Tensor, " n"]:
    """Distance of a point along each camera's optical axis, negative behind it.

    Args:
        poses: camera-to-world.
        point: in the same frame.
    """
    return ((point - poses[:, :3, 3]) * poses[:, :3, 2]).sum(dim=1)


def pictured_ball(cameras: Sequence[Camera]) -> tuple[Float[Tensor, 3], float] | None:
    """Centre and radius of the ball around the cameras' common focus that their pictures just hold, in the median.

    Args:
        cameras: float64.

    Returns:
        ``None`` where most cameras do not look at a common focus.
    """
    poses = torch.stack([camera.cam_to_world for camera in cameras])
    focus = common_focus(poses)
    if focus is None or float(ahead_of(poses, focus).median()) <= 0:
        return None
    half_view = torch.stack([max(camera.width, camera.height) / 2 / camera.focal.min() for camera in cameras])
    return focus, float(((focus - poses[:, :3, 3]).norm(dim=1) * half_view).median())


def subject_half(points: Float[Tensor, "n 3"]) -> float:
    """Half edge of the cube around the origin that holds the subject with a margin, local units, at most 1.

    Args:
        points: surface points, local frame.
    """
    if len(points) < FEWEST:
        return 1.0
    radius = float(np.quantile(points.norm(dim=1).double().numpy(), SUBJECT_SHARE))  # torch's takes no more than 2^24 values
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
            nearest.append(float(np.quantile(ahead.numpy(), NEAREST_SHARE)))
    return CLEARANCE * min(nearest) if nearest else None


def photo_frame(photos: Sequence[Photo], points: Points | None = None, conventional: float | None = None) -> LocalFrame:
    """Compute the local frame of photographs: of an object in a box, if they show one (`object_frame`), else of endless space.

    Args:
        photos: their cameras float64.
        points: known surface points, world frame; kept.
        conventional: as for `object_frame`.

    Raises:
        InputError: a photograph cannot be read, or the cameras are farther apart than numbers reach.
    """
    cameras = [photo.camera for photo in photos]
    pictures = [read_pixels(photo.path) for photo in looked_at(photos)]
    frame = object_frame(cameras, pictures, points, conventional)
    return frame or contracted_frame(torch.stack([camera.cam_to_world for camera in cameras]), points)


def object_frame(
    cameras: Sequence[Camera],
    pictures: Sequence[UInt8[np.ndarray, "h w c"]],
    points: Points | None = None,
    conventional: float | None = None,
) -> LocalFrame | None:
    """Compute the local frame of an object in a box, from what its pictures show; ``None`` where they show more, or no focus.

    Args:
        cameras: float64.
        pictures: those of some of the cameras, straight colour or colour and alpha.
        points: known surface points, world frame; kept.
        conventional: half-edge of the box around the origin in which data sets of this format have objects; taken where it fits
            the pictures. Without it a black border may be the rim of a lens, and is no evidence.
    """
    if not is_object(pictures, black=conventional is not None) or (seen := pictured_ball(cameras)) is None:
        return None
    centre, radius = seen
    half = BOX_MARGIN * radius
    if conventional and float(centre.norm()) <= OFF_CENTRE * conventional:
        least, most = CONVENTIONAL
        if least * radius <= conventional <= most * radius:
            centre, half = torch.zeros_like(centre), conventional
    return box_frame(centre - half, centre + half, points)


def box_frame(lo: Float[Tensor, 3], hi: Float[Tensor, 3], points: Points | None = None) -> LocalFrame:
    """Compute the local frame of an object in a box: the world itself, or the box moved to the origin and scaled to `BOX_HALF`.

    Densities per length and the near distance are made for boxes of about that size; a box far smaller, larger or farther away
    is not fitted as well in its own units.

    Args:
        lo: lowest corner, world frame, float64.
        hi: highest corner.
        points: known surface points, world frame; kept.
    """
    half, centre = float((hi - lo).max()) / 2, (lo + hi) / 2
    least, most = BOX_HALVES
    usual = least <= half <= most and float(centre.abs().max()) <= most
    if usual or not math.isfinite(half):  # what is not finite is refused with the scene
        return LocalFrame(Bounds(lo.float(), hi.float()), points=points)
    world_from_local = torch.eye(4, dtype=torch.float64)
    world_from_local[:3, :3] *= half / BOX_HALF
    world_from_local[:3, 3] = centre
    corner = ((hi - lo) / 2 / half * BOX_HALF).float()
    return LocalFrame(Bounds(-corner, corner), world_from_local, points)


def contracted_frame(
    poses: Float[Tensor, "n 4 4"], points: Points | None = None, distance: float | None = None, near: float | None = None
) -> LocalFrame:
    """Compute the local frame of an unbounded scene: +z is the mean up, the subject at the origin, cameras in the unit ball.

    The subject is where the optical axes come closest to each other. Where they are too parallel for that it lies ``distance``
    ahead of the cameras, and where it would be behind them (an inside-out rig) it is the middle of the cameras. The box is
    fitted to most of the points (`subject_half`), if there are any.

    Args:
        poses: camera-to-world, float64.
        points: known surface points, world frame; kept, and used for what is not given.
        distance: how far ahead the subject is, world units.
        near: closest thing in front of a camera, world units; by default somewhat less than the distance of the nearest points.
    """
    position, forward = poses[:, :3, 3], poses[:, :3, 2]
    middle = position.mean(dim=0)
    if distance is None:
        spread = (position - middle).norm(dim=1).max()
        known = points is not None and len(points) > 0
        distance = float((points.position.double() - middle).norm(dim=1).median() if known and points else 2 * spread)
    focus = common_focus(poses)
    if focus is None:
        centre = middle + distance * torch.nn.functional.normalize(forward.mean(dim=0), dim=0)
    else:
        centre = focus if float(ahead_of(poses, focus).median()) > 0 else middle
    radius, offset = float((position - centre).norm(dim=1).max()), float(centre.norm())
    if not math.isfinite(radius + offset):
        raise InputError("The cameras are farther apart than numbers reach.", "Check the positions of the poses.")
    if radius <= ROUNDING * max(1.0, offset):  # on a tripod
        radius = 1.0
    world_from_local = torch.eye(4, dtype=poses.dtype)
    world_from_local[:3, :3] = radius * _turn_z_to(-poses[:, :3, 1].mean(dim=0))
    world_from_local[:3, 3] = centre
    known = torch.zeros(0, 3, dtype=poses.dtype) if points is None else points.position.to(poses.dtype)
    near = near_plane(poses, known) if near is None else near
    half = torch.full((3,), subject_half((known - centre) / radius))
    bounds = Bounds(-half, half, "contracted", near=NEAR if near is None else near / radius)
    return LocalFrame(bounds, world_from_local, points)


def _turn_z_to(up: Float[Tensor, 3]) -> Float[Tensor, "3 3"]:
    """Smallest rotation from +z to ``up``; identity where the cameras have no common up."""
    length = float(up.norm())
    if length < 0.1:
        return torch.eye(3, dtype=up.dtype)
    x, y, z = (up / length).tolist()
    if z < -1 + 1e-9:
        return torch.diag(up.new_tensor([1.0, -1.0, -1.0]))
    # Rodrigues' formula for the axis z × up.
    skew = up.new_tensor([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return torch.eye(3, dtype=up.dtype) + skew + skew @ skew / (1 + z)
