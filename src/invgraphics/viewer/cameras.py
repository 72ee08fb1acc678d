"""Between the browser's camera and ours.

Viser's cameras have our axes (+x right, +y down, +z forward) and quaternions (w, x, y, z), so only the lens differs: a browser
has a vertical field of view, square pixels, and its optical axis in the middle of the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera
from invgraphics.core.transforms import quaternion_to_matrix, rigid

FLAT = 1e-3
"""Relative difference of a camera's focal lengths up to which its pixels count as square."""


@dataclass(frozen=True, eq=False)
class Gaze:
    """Where a browser looks.

    Attributes:
        pose: camera-to-world in the scene's local frame, float32.
        fov: vertical field of view in radians.
        aspect: the window's width over its height.
    """

    pose: Float[Tensor, "4 4"]
    fov: float
    aspect: float

    @staticmethod
    def of(wxyz: tuple[float, ...], position: tuple[float, ...], fov: float, aspect: float) -> Gaze:
        """From what a browser reports: rotation as a quaternion (w, x, y, z), position, vertical field of view, aspect."""
        rotation = quaternion_to_matrix(torch.tensor([float(value) for value in wxyz], dtype=torch.float64))
        place = torch.tensor([float(value) for value in position], dtype=torch.float64)
        return Gaze(rigid(rotation, place).float(), float(fov), float(aspect))

    def camera(self, width: int, height: int) -> Camera:
        """The camera whose picture of ``width`` x ``height`` pixels fills the window exactly."""
        tangent = math.tan(self.fov / 2)
        focal = torch.tensor([width / 2 / (tangent * self.aspect), height / 2 / tangent])
        return Camera(self.pose, focal, torch.tensor([width / 2, height / 2]), width, height)

    def sees_from(self, pose: Float[Tensor, "4 4"], reach: float, angle: float) -> bool:
        """Whether the browser stands at ``pose``: within ``reach`` (local units), and ``angle`` (radians)."""
        turn = float((self.pose[:3, :3] - pose[:3, :3]).norm()) / math.sqrt(2)
        return float((self.pose[:3, 3] - pose[:3, 3]).norm()) <= reach and turn <= angle


@dataclass(frozen=True, eq=False)
class Mount:
    """A photograph's camera in a browser's window: the photograph whole, and its optical axis in the window's middle.

    Attributes:
        camera: of the photograph, with square pixels.
        width: of the window, in the photograph's pixels.
        height: likewise.
        left: column of the window in which the photograph begins.
        top: row in which it begins.
    """

    camera: Camera
    width: int
    height: int
    left: int
    top: int

    @staticmethod
    def of(camera: Camera, aspect: float) -> Mount:
        """Put a photograph into a window of an aspect (width over height), as large as it fits."""
        square = with_square_pixels(camera)
        cx, cy = square.centre.tolist()
        across, down = 2 * max(cx, square.width - cx), 2 * max(cy, square.height - cy)
        height = math.ceil(max(down, across / aspect))
        width = max(math.ceil(across), round(height * aspect))
        left, top = _between(width / 2 - cx, width - square.width), _between(height / 2 - cy, height - square.height)
        return Mount(square, width, height, left, top)

    @property
    def fov(self) -> float:
        """Vertical field of view of the window, in radians."""
        return 2 * math.atan(self.height / 2 / float(self.camera.focal[1]))


def _between(offset: float, most: int) -> int:
    return max(0, min(round(offset), most))


def with_square_pixels(camera: Camera) -> Camera:
    """The camera, of a photograph stretched sideways if its focal lengths differ."""
    fx, fy = camera.focal.tolist()
    if abs(fx / fy - 1) < FLAT:
        return camera
    return camera.resized(max(1, round(camera.width * fy / fx)), camera.height)


def quaternion(pose: Float[Tensor, "4 4"]) -> tuple[float, float, float, float]:
    """The rotation of a pose as a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(pose[:3, :3].double().numpy()).as_quat().tolist()
    return w, x, y, z


def frustum(camera: Camera) -> tuple[float, float]:
    """Vertical field of view in radians and aspect of a camera's pyramid, as if its axis were in the picture's middle."""
    fx, fy = camera.focal.tolist()
    return 2 * math.atan(camera.height / 2 / fy), camera.width / fx / (camera.height / fy)


def part(camera: Camera, columns: tuple[int, int], rows: tuple[int, int]) -> Camera:
    """The camera of a rectangle of the picture, both ranges half open."""
    corner = camera.centre.new_tensor([columns[0], rows[0]])
    return replace(camera, centre=camera.centre - corner, width=columns[1] - columns[0], height=rows[1] - rows[0])


def limited(camera: Camera, longest: int) -> Camera:
    """The camera of the picture reduced to ``longest`` pixels along its longest side; never enlarged."""
    return scaled(camera, min(1.0, longest / max(camera.width, camera.height)))


def scaled(camera: Camera, scale: float) -> Camera:
    """The camera of the picture at another scale, with whole pixels."""
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
