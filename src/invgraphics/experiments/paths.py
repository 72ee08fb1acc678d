"""Camera paths through a scene, for films."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Scene
from invgraphics.core.transforms import look_at

PARALLEL = 1e-2
"""Mean squared sine of the angles between optical axes and a common direction below which they have no common point."""
STOPS = 8
"""Photographs that an interpolated path comes by."""


def orbit(scene: Scene, frames: int) -> list[Camera]:
    """Once around what the photographs look at, as high above it and as far away as they were taken.

    The axis is the photographs' mean upward direction, the lens that of the first test view.
    """
    cameras = [view.camera for view in scene.train]
    target = _focus(cameras, scene.bounds.centre)
    up = torch.nn.functional.normalize(-torch.stack([camera.cam_to_world[:3, 1] for camera in cameras]).mean(dim=0), dim=0)
    offset = torch.stack([camera.position for camera in cameras]) - target
    height = (offset @ up).median()
    flat = offset - (offset @ up)[:, None] * up
    distance = flat.norm(dim=1).median()
    x = torch.nn.functional.normalize(flat[flat.norm(dim=1).argmax()], dim=0)
    y = torch.linalg.cross(up, x)
    path = []
    for frame in range(frames):
        turn = 2 * math.pi * frame / frames
        eye = target + height * up + distance * (math.cos(turn) * x + math.sin(turn) * y)
        path.append(scene.test[0].camera.moved(look_at(eye, target, up)))
    return path


def _focus(cameras: Sequence[Camera], otherwise: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The point nearest to all optical axes (least squares), unless those are parallel or it lies behind some camera."""
    forward = torch.stack([camera.cam_to_world[:3, 2] for camera in cameras]).double()
    position = torch.stack([camera.position for camera in cameras]).double()
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    matrix = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(matrix)[0]) < PARALLEL:
        return otherwise
    point = torch.linalg.solve(matrix, (across @ position[:, :, None]).mean(dim=0)[:, 0])
    seen = ((point - position) * forward).sum(dim=1) > 0
    return point.to(otherwise) if bool(seen.all()) else otherwise


def interpolate(scene: Scene, frames: int) -> list[Camera]:
    """A closed path by some of the photographs' cameras: positions on a spline, rotations by the shortest turns between."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    stops = _tour([view.camera for view in scene.train])
    if len(stops) == 1:
        return stops * frames
    poses = torch.stack([camera.cam_to_world for camera in (*stops, stops[0])]).double().numpy()
    times = np.arange(len(poses))
    moments = np.linspace(0, len(stops), frames, endpoint=False)
    positions = CubicSpline(times, poses[:, :3, 3], bc_type="periodic")(moments)
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(moments).as_matrix()
    lens = scene.test[0].camera
    return [lens.moved(_pose(r, p)) for r, p in zip(rotations, positions, strict=True)]


def _tour(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras far apart from one another, each followed by the nearest that is left."""
    position = torch.stack([camera.position for camera in cameras])
    chosen = [0]
    while len(chosen) < min(STOPS, len(cameras)):
        chosen.append(int(torch.cdist(position, position[chosen]).amin(dim=1).argmax()))
    order = [chosen.pop(0)]
    while chosen:
        nearest = min(chosen, key=lambda i: float((position[i] - position[order[-1]]).norm()))
        chosen.remove(nearest)
        order.append(nearest)
    return [cameras[i] for i in order]


def _pose(rotation: np.ndarray, position: np.ndarray) -> Float[Tensor, "4 4"]:
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(rotation).float(), torch.from_numpy(position).float()
    return pose
