"""Camera paths through keyframes: interpolation, and their JSON files."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from invgraphics.core import Camera, Scene
from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.tables import LIMITS, parse_json, read_json
from invgraphics.tools.paths import interpolate_poses

SCHEMA = 1
KIND = "camera path"
RIGID = 1e-3
"""Largest deviation of R Rᵀ from the identity in a file."""
NARROWEST = 1e-3
"""Smallest vertical field of view of a keyframe, degrees."""
MOST_SECONDS = 3600.0


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Keyframe of a camera path: pose and field of view.

    Attributes:
        pose: camera-to-world in the data set's world frame; +x right, +y down, +z forward.
        fov: vertical field of view, radians.
    """

    pose: Float[Tensor, "4 4"]
    fov: float

    @staticmethod
    def from_local(pose: Float[Tensor, "4 4"], fov: float, scene: Scene) -> Keyframe:
        """Make a keyframe from a pose in the scene's local frame."""
        return Keyframe(apply_similarity(scene.world_from_local.double(), pose.double()), fov)

    def local_pose(self, scene: Scene) -> Float[Tensor, "4 4"]:
        """The pose in a scene's local frame, float32."""
        return apply_similarity(torch.linalg.inv(scene.world_from_local.double()), self.pose.double()).float()


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Keyframes in order, evenly spaced in time.

    Attributes:
        keyframes: at least one.
        seconds: from each keyframe to the next.
        loop: whether the path returns to the first keyframe.
    """

    keyframes: tuple[Keyframe, ...]
    seconds: float = 2.0
    loop: bool = False

    @property
    def duration(self) -> float:
        """Seconds of the whole path."""
        return self.seconds * (len(self.keyframes) - (0 if self.loop and len(self.keyframes) > 1 else 1))

    def frame_count(self, rate: float) -> int:
        """Frames of the whole path at ``rate`` frames per second, at least one."""
        return max(1, round(self.duration * rate) + (not self.loop))

    def frame_times(self, count: int) -> Float[ndarray, " count"]:
        """Times of ``count`` evenly spaced frames, seconds; a loop leaves out its end, which is its start."""
        return np.linspace(0.0, self.duration, count, endpoint=not self.loop)

    def at(self, times: Float[ndarray, " m"]) -> list[Keyframe]:
        """Interpolated cameras: cubic splines of position and rotation, a monotone cubic of the field of view."""
        from scipy.interpolate import PchipInterpolator

        if len(self.keyframes) == 1:
            return [self.keyframes[0]] * len(times)
        moments = np.asarray(times, float) / self.seconds
        poses = torch.stack([keyframe.pose for keyframe in self.keyframes]).double().numpy()
        fovs = np.array([keyframe.fov for keyframe in self.keyframes] + ([self.keyframes[0].fov] if self.loop else []))
        fov = PchipInterpolator(np.arange(len(fovs)), fovs)(moments)
        found = interpolate_poses(poses, moments, self.loop)
        return [Keyframe(torch.from_numpy(pose), float(angle)) for pose, angle in zip(found, fov, strict=True)]

    def cameras(self, scene: Scene, count: int, size: tuple[int, int]) -> list[Camera]:
        """``count`` pinhole cameras of ``size`` (width, height) along the path, in the scene's local frame."""
        return [pinhole(keyframe, scene, *size) for keyframe in self.at(self.frame_times(count))]

    def write(self, file: Path) -> None:
        """Write the path as JSON.

        Raises:
            InputError: the file cannot be written.
        """
        try:
            write_text(file, self.to_json())
        except OSError as error:
            raise InputError(f"'{file}' cannot be written: {error.strerror}.", "Choose another file.") from error

    def to_json(self) -> str:
        """The path as JSON text."""
        keyframes = [
            {"camera_to_world": keyframe.pose.double().tolist(), "fov_degrees": math.degrees(keyframe.fov)}
            for keyframe in self.keyframes
        ]
        table = {
            "schema": SCHEMA,
            "kind": KIND,
            "frame": "world, +x right, +y down, +z forward",
            "seconds_between_keyframes": self.seconds,
            "loop": self.loop,
            "keyframes": keyframes,
        }
        return json.dumps(table, indent=2) + "\n"


def pinhole(keyframe: Keyframe, scene: Scene, width: int, height: int) -> Camera:
    """The keyframe's camera with square pixels and a centred principal point, in the scene's local frame."""
    focal = height / 2 / math.tan(keyframe.fov / 2)
    centre = torch.tensor([width / 2, height / 2])
    return Camera(keyframe.local_pose(scene), torch.tensor([focal, focal]), centre, width, height)


def read_camera_path(file: Path) -> CameraPath:
    """Read a path that `CameraPath.write` or the viewer wrote.

    Raises:
        InputError: the file cannot be read or holds no valid camera path.
    """
    try:
        table = read_json(file)
    except InputError as error:
        raise InputError(f"The camera path '{file}' cannot be read: {error.sentence}", "Save one in the viewer.") from error
    return _camera_path(table, str(file))


def parse_camera_path(content: bytes, name: str) -> CameraPath:
    """Read a path from the content of a file of this name.

    Raises:
        InputError: it is no valid camera path.
    """
    try:
        if len(content) > LIMITS.json_bytes:
            raise ValueError(f"it has {len(content)} bytes, more than {LIMITS.json_bytes}")
        text = content.decode("utf-8-sig")
    except ValueError as error:  # UnicodeDecodeError is one
        raise InputError(f"'{name}' is no text that can be used: {error}.", "Choose a file that the viewer saved.") from error
    return _camera_path(parse_json(text, f"'{name}'"), name)


def _camera_path(table: Any, file: str) -> CameraPath:
    if not isinstance(table, dict) or table.get("kind") != KIND:
        raise _invalid(file, f'has no "kind": "{KIND}"')
    if table.get("schema") != SCHEMA:
        raise InputError(f"'{file}' has schema {table.get('schema')}; this version reads {SCHEMA}.", "Update invgraphics.")
    keyframes = table.get("keyframes")
    if not isinstance(keyframes, list) or not keyframes:
        raise _invalid(file, "has no keyframes")
    seconds = table.get("seconds_between_keyframes")
    if not _is_number(seconds) or not 0 < seconds <= MOST_SECONDS:
        raise _invalid(file, f"has seconds_between_keyframes {seconds}, not in (0, {MOST_SECONDS:g}]")
    if not isinstance(table.get("loop"), bool):
        raise _invalid(file, f"has loop {table.get('loop')}, neither true nor false")
    return CameraPath(tuple(_keyframe(entry, index, file) for index, entry in enumerate(keyframes)), seconds, table["loop"])


def _keyframe(entry: Any, index: int, file: str) -> Keyframe:
    rows, degrees = (entry.get(key) if isinstance(entry, dict) else None for key in ("camera_to_world", "fov_degrees"))
    if not _is_number(degrees) or not NARROWEST <= degrees < 180:
        raise _invalid(file, f"has fov_degrees {degrees} at keyframe {index}, not between {NARROWEST:g} and 180")
    if not _is_matrix(rows):
        raise _invalid(file, f"has no 4 x 4 camera_to_world at keyframe {index}")
    pose = torch.tensor(rows, dtype=torch.float64)
    rotation, last = pose[:3, :3], pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    deviation = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if not (deviation < RIGID and torch.linalg.det(rotation) > 0 and bool((pose[3] == last).all())):
        raise _invalid(file, f"has a camera_to_world at keyframe {index} that is not a rotation and a translation")
    if not bool((pose.float() ** 2).isfinite().all()):
        raise _invalid(file, f"has a camera at keyframe {index} that is too far away for float32")
    return Keyframe(pose, math.radians(degrees))


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_matrix(rows: Any) -> bool:
    def is_row(row: Any) -> bool:
        return isinstance(row, list) and len(row) == 4 and all(_is_number(value) for value in row)

    return isinstance(rows, list) and len(rows) == 4 and all(is_row(row) for row in rows)


def _invalid(file: str, what: str) -> InputError:
    return InputError(f"'{file}' {what}.", "Expected a camera path as the viewer saves it.")


def without(path: CameraPath, index: int) -> CameraPath:
    """Remove one keyframe from a path."""
    return replace(path, keyframes=path.keyframes[:index] + path.keyframes[index + 1 :])


def with_keyframe(path: CameraPath, keyframe: Keyframe, after: int | None = None) -> CameraPath:
    """Insert a keyframe after an index of a path, or at its end."""
    place = len(path.keyframes) if after is None else after + 1
    keyframes: Sequence[Keyframe] = (*path.keyframes[:place], keyframe, *path.keyframes[place:])
    return replace(path, keyframes=tuple(keyframes))
