"""The only place where an axis is flipped: other programs' camera poses to and from ours.

Ours (OpenCV): +x right, +y down, +z forward; camera-to-world. Every function takes and returns 4x4 camera-to-world unless
its name says otherwise, and every ``x_to_opencv`` has its inverse ``opencv_to_x``.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.errors import InputError

Pose = Float[Tensor, "4 4"]

AXES = {"opencv": "RDF", "opengl": "RUB", "z-up": "RFU"}
"""Frames by name, as the letters that `axes_to_opencv` reads."""

PARALLEL = 1e-6
"""Sine of the angle between two directions below which their cross product is rounding noise."""

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


def _flipped(pose: Pose, signs: tuple[float, float, float]) -> Pose:
    return pose * pose.new_tensor([*signs, 1.0])


def opengl_to_opencv(pose: Pose) -> Pose:
    """OpenGL and Blender (``transforms.json``): +x right, +y up, +z backward."""
    return _flipped(pose, (1, -1, -1))


def opencv_to_opengl(pose: Pose) -> Pose:
    """Inverse of `opengl_to_opencv` (the map is its own inverse)."""
    return _flipped(pose, (1, -1, -1))


def mitsuba_to_opencv(pose: Pose) -> Pose:
    """Mitsuba 3 sensors: +x left, +y up, +z forward."""
    return _flipped(pose, (-1, -1, 1))


def opencv_to_mitsuba(pose: Pose) -> Pose:
    """Inverse of `mitsuba_to_opencv` (the map is its own inverse)."""
    return _flipped(pose, (-1, -1, 1))


def colmap_to_opencv(world_to_cam: Float[Tensor, "3 4"]) -> Pose:
    """COLMAP: OpenCV axes already, but world-to-camera."""
    rotation, translation = world_to_cam[:, :3].T, world_to_cam[:, 3]
    return rigid(rotation, -(rotation @ translation))


def opencv_to_colmap(pose: Pose) -> Float[Tensor, "3 4"]:
    """Inverse of `colmap_to_opencv`."""
    rotation = pose[:3, :3].T
    return torch.cat([rotation, -(rotation @ pose[:3, 3])[:, None]], dim=1)


def llff_to_opencv(pose: Float[Tensor, "3 4"]) -> Pose:
    """LLFF ``poses_bounds.npy`` (first four columns): columns are down, right, backward, position."""
    down, right, back, position = pose.unbind(dim=1)
    return rigid(torch.stack([right, down, -back], dim=1), position)


def opencv_to_llff(pose: Pose) -> Float[Tensor, "3 4"]:
    """Inverse of `llff_to_opencv`."""
    right, down, forward, position = pose[:3].unbind(dim=1)
    return torch.stack([down, right, -forward, position], dim=1)


def axes_to_opencv(axes: str) -> Pose:
    """The rotation from a world frame to the one whose axes point right, down and forward, float64.

    Args:
        axes: a name in `AXES`; or three letters that say where +x, +y and +z point: R or L, U or D, F or B.

    Raises:
        InputError: these are no axes, or those of a left-handed frame, to which no rotation leads.
    """
    letters = AXES.get(axes, axes.upper())
    if len(letters) != 3 or not set(letters) <= set(_DIRECTIONS):
        raise InputError(
            f"'{axes}' names no axes.", f"Expected {', '.join(AXES)}, or where +x, +y, +z point: RDF is right, down, forward."
        )
    rotation = torch.tensor([_DIRECTIONS[letter] for letter in letters], dtype=torch.float64).T
    if float(torch.linalg.det(rotation)) < 0.5:
        raise InputError(f"The axes '{axes}' are no right-handed frame.", "Convert the file to RDF or RUB axes first.")
    return rigid(rotation, torch.zeros(3, dtype=torch.float64))


def opencv_to_axes(axes: str) -> Pose:
    """Inverse of `axes_to_opencv`."""
    return axes_to_opencv(axes).T.contiguous()


def rigid(rotation: Float[Tensor, "3 3"], translation: Float[Tensor, 3]) -> Pose:
    """A 4x4 from a rotation and a translation."""
    bottom = rotation.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), bottom])


def look_at(eye: Float[Tensor, 3], target: Float[Tensor, 3], up: Float[Tensor, 3]) -> Pose:
    """The pose of a camera at ``eye`` that sees ``target`` in the middle and ``up`` upwards.

    A camera that looks along ``up`` has the axis of the world that is most across its view upwards instead.

    Raises:
        ValueError: ``eye`` and ``target`` are one point.
    """
    if torch.equal(eye, target):
        raise ValueError("a camera cannot look at its own position")
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) <= PARALLEL * float(up.norm()):
        right = torch.linalg.cross(forward, torch.eye(3).to(up)[forward.abs().argmin()])
    right = torch.nn.functional.normalize(right, dim=0)
    return rigid(torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1), eye)


def apply_similarity(similarity: Pose, pose: Pose) -> Pose:
    """Move a camera by a similarity: the position is scaled, the rotation stays rigid."""
    scale = torch.linalg.det(similarity[:3, :3]) ** (1 / 3)
    return rigid(similarity[:3, :3] / scale @ pose[:3, :3], similarity[:3, :3] @ pose[:3, 3] + similarity[:3, 3])


def transform_points(transform: Pose, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Apply a 4x4 affine transform to points."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def quaternion_to_matrix(quaternion: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), which are normalised first."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def se3_exp(twist: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 4 4"]:
    """Exponential of twists (rotation vector, translation): the rigid motions they generate, smooth at zero.

    Rodrigues' closed form: ``R = I + a W + b W²`` and ``t = (I + b W + c W²) v`` with W the cross product with the rotation
    vector, ``a = sin θ / θ``, ``b = (1 - cos θ) / θ²``, ``c = (θ - sin θ) / θ³``.
    """
    turn, shift = twist[..., :3], twist[..., 3:]
    squared = turn.square().sum(dim=-1)[..., None, None]
    small = squared < 1e-2
    # Where the closed form would be 0 / 0 (or lose its digits), five terms of the series are exact.
    theta = torch.where(small, 1.0, squared).sqrt()
    a = torch.where(small, _series(squared, 1), theta.sin() / theta)
    b = torch.where(small, _series(squared, 2), 2 * (theta / 2).sin().square() / theta.square())
    c = torch.where(small, _series(squared, 3), (theta - theta.sin()) / theta**3)
    x, y, z = turn.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = eye + a * cross + b * (cross @ cross)
    moved = (eye + b * cross + c * (cross @ cross)) @ shift[..., None]
    bottom = twist.new_tensor([[0.0, 0.0, 0.0, 1.0]]).expand(*twist.shape[:-1], 1, 4)
    return torch.cat([torch.cat([rotation, moved], dim=-1), bottom], dim=-2)


def _series(squared: Tensor, first: int) -> Tensor:
    """``∑ (-x²)^k / (2k + first)!`` for k = 0 .. 4."""
    total = torch.zeros_like(squared)
    for k in reversed(range(5)):
        total = 1 / math.factorial(2 * k + first) - squared * total
    return total


def focal_from_fov(fov: float, width: int) -> float:
    """Focal length in pixels of a horizontal field of view in radians (Blender's ``camera_angle_x``)."""
    return 0.5 * width / math.tan(0.5 * fov)
