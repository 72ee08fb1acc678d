"""Camera paths through a scene, for films."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Scene
from invgraphics.core.transforms import look_at
from invgraphics.scenes.region import ahead_of, common_focus

STOPS = 8
"""Photographs that an interpolated path comes by."""
WIDEST_GAP = 120.0
"""Degrees of azimuth without a camera up to which cameras surround what they look at."""
LEAST_UP = 1e-3
"""Length of the mean of unit directions up to which they cancel."""
ONE_WAY = 30.0
"""Degrees from the mean viewing direction within which nine cameras in ten of a forward-facing capture look."""
SPIRAL_TURNS = 2
"""Turns of a spiral, in which it goes once forward and back."""

WRAPPED = 8
"""Keyframes of a loop repeated at either end: the influence of farther ones on a spline has decayed."""

PathName = Literal["orbit", "spiral", "interpolate"]


@dataclass(frozen=True)
class Capture:
    """Kind of a scene's capture, and the camera path that stays among its photographs.

    Attributes:
        path: orbit where cameras surround the subject, spiral where all face one way, otherwise interpolation.
        words: the reason, as a clause whose subject is the photographs.
    """

    path: PathName
    words: str


def classify_capture(scene: Scene) -> Capture:
    """Classify a capture by the azimuths of the training cameras around their subject, and by their viewing directions."""
    cameras = [view.camera for view in scene.train]
    forward, position, up = _axis(cameras, 2), torch.stack([camera.position for camera in cameras]), _mean_up(cameras)
    mean = torch.nn.functional.normalize(forward.mean(dim=0), dim=0)
    angles = torch.rad2deg((forward @ mean).clamp(-1, 1).acos())
    if float(angles.quantile(0.9)) <= ONE_WAY:
        return Capture("spiral", f"face one way, within {float(angles.quantile(0.9)):.0f} degrees")
    offset = position - _focus(cameras, scene.bounds.centre)
    if float((offset * forward).sum(dim=1).median()) >= 0:
        return Capture("interpolate", "look outwards")
    covered = 360 - _widest_gap(offset, up)
    if covered >= 360 - WIDEST_GAP:
        return Capture("orbit", "surround the subject")
    return Capture("interpolate", f"cover {covered:.0f} degrees around the subject")


def _axis(cameras: Sequence[Camera], column: int) -> Float[Tensor, "n 3"]:
    return torch.stack([camera.cam_to_world[:3, column] for camera in cameras])


def _mean_up(cameras: Sequence[Camera]) -> Float[Tensor, " 3"]:
    """Mean upward direction; the first camera's where headings cancel, as of a drone that looks straight down."""
    mean = -_axis(cameras, 1).mean(dim=0)
    return torch.nn.functional.normalize(mean if float(mean.norm()) > LEAST_UP else -cameras[0].cam_to_world[:3, 1], dim=0)


def _widest_gap(offset: Float[Tensor, "n 3"], up: Float[Tensor, " 3"]) -> float:
    """The widest interval of azimuths around ``up`` without an offset, degrees."""
    flat = offset - (offset @ up)[:, None] * up
    x = torch.nn.functional.normalize(flat[flat.norm(dim=1).argmax()], dim=0)
    azimuth = torch.rad2deg(torch.atan2(flat @ torch.linalg.cross(up, x), flat @ x)).sort().values
    return float(torch.cat([azimuth.diff(), azimuth[:1] + 360 - azimuth[-1:]]).max())


def spiral(scene: Scene, frames: int) -> list[Camera]:
    """Closed spiral path of LLFF: ellipses within the cameras' window, moving forward and back, looking at their subject.

    The half-axes are the 90th percentiles of the cameras' distances from their mean along its right, down and forward axes.
    """
    cameras = [view.camera for view in scene.train]
    position, up = torch.stack([camera.position for camera in cameras]), _mean_up(cameras)
    middle, forward = position.mean(dim=0), torch.nn.functional.normalize(_axis(cameras, 2).mean(dim=0), dim=0)
    ahead = float((_focus(cameras, scene.bounds.centre) - middle) @ forward)
    target = middle + (ahead if ahead > 0 else scene.extent) * forward
    axes = look_at(middle, target, up)[:3, :3]
    half = ((position - middle) @ axes).abs().quantile(0.9, dim=0)
    path = []
    for frame in range(frames):
        turn = 2 * math.pi * frame / frames
        ellipse = half.new_tensor([math.cos(SPIRAL_TURNS * turn), math.sin(SPIRAL_TURNS * turn), math.sin(turn)])
        path.append(scene.test[0].camera.moved(look_at(middle + axes @ (half * ellipse), target, up)))
    return path


def orbit(scene: Scene, frames: int) -> list[Camera]:
    """Circular path around the cameras' common focus, at their median height and distance.

    The axis is the photographs' mean upward direction, the lens that of the first test view.
    """
    cameras = [view.camera for view in scene.train]
    target = _focus(cameras, scene.bounds.centre)
    up = _mean_up(cameras)
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
    """Least-squares point nearest to all optical axes; a fallback where those are parallel or it lies behind a camera."""
    poses = torch.stack([camera.cam_to_world for camera in cameras]).double()
    point = common_focus(poses)
    if point is None or bool((ahead_of(poses, point) <= 0).any()):
        return otherwise
    return point.to(otherwise)


def interpolate(scene: Scene, frames: int) -> list[Camera]:
    """Interpolate a closed path through some of the training cameras: splines of positions and rotations."""
    stops = _tour([view.camera for view in scene.train])
    if len(stops) == 1:
        return stops * frames
    poses = torch.stack([camera.cam_to_world for camera in stops]).double().numpy()
    moments = np.linspace(0, len(stops), frames, endpoint=False)
    lens = scene.test[0].camera
    return [lens.moved(torch.from_numpy(pose).float()) for pose in interpolate_poses(poses, moments, loop=True)]


def interpolate_poses(poses: Float[np.ndarray, "k 4 4"], moments: Float[np.ndarray, " m"], loop: bool) -> np.ndarray:
    """Rigid poses at fractional indices: cubic splines of positions and rotations through every pose.

    Args:
        poses: at least two.
        moments: 0 to k - 1, or to k for a loop, whose end is its start.
        loop: whether the last pose is followed by the first, smoothly.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    count, around = len(poses), WRAPPED if loop else 0
    times = np.arange(-around, count + around + loop)
    knots = poses[times % count]  # a loop's neighbours on either side make its seam as smooth as the rest
    natural = CubicSpline(times, knots[:, :3, 3], bc_type="natural")
    found = np.tile(np.eye(4), (len(moments), 1, 1))
    found[:, :3, 3] = natural(moments)
    found[:, :3, :3] = RotationSpline(times, Rotation.from_matrix(knots[:, :3, :3]))(moments).as_matrix()
    return found


PATHS: dict[PathName, Callable[[Scene, int], list[Camera]]] = {"orbit": orbit, "spiral": spiral, "interpolate": interpolate}
"""Makers of paths by name: scene and number of frames -> cameras."""


def _tour(cameras: Sequence[Camera]) -> list[Camera]:
    """Select cameras far apart from one another, ordered by nearest neighbour."""
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
