"""Conversion between viser's cameras and the project's pinhole cameras.

Viser's cameras have our axes (+x right, +y down, +z forward) and quaternions (w, x, y, z), so only the lens differs: a browser
has a vertical field of view, square pixels, and its optical axis in the middle of the window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, View
from invgraphics.core.transforms import quaternion_to_matrix, rigid

SQUARE_TOLERANCE = 1e-3
"""Relative difference of a camera's focal lengths up to which its pixels count as square."""


@dataclass(frozen=True, eq=False)
class ViewerCamera:
    """Camera of a browser window: pose, vertical field of view and aspect.

    Attributes:
        pose: camera-to-world in the scene's local frame, float32.
        fov: vertical field of view in radians.
        aspect: the window's width over its height.
    """

    pose: Float[Tensor, "4 4"]
    fov: float
    aspect: float

    @staticmethod
    def from_viser(wxyz: tuple[float, ...], position: tuple[float, ...], fov: float, aspect: float) -> ViewerCamera:
        """From viser's camera state: unit quaternion (w, x, y, z), position, vertical field of view in radians, aspect."""
        rotation = quaternion_to_matrix(torch.tensor([float(value) for value in wxyz], dtype=torch.float64))
        place = torch.tensor([float(value) for value in position], dtype=torch.float64)
        return ViewerCamera(rigid(rotation, place).float(), float(fov), float(aspect))

    def pinhole(self, width: int, height: int) -> Camera:
        """Pinhole camera of ``width`` x ``height`` pixels with this pose and field of view."""
        tangent = math.tan(self.fov / 2)
        focal = torch.tensor([width / 2 / (tangent * self.aspect), height / 2 / tangent])
        return Camera(self.pose, focal, torch.tensor([width / 2, height / 2]), width, height)

    def is_at(self, pose: Float[Tensor, "4 4"], reach: float, angle: float) -> bool:
        """Whether this camera is at ``pose``: within ``reach`` (local units) and ``angle`` (radians)."""
        turn = float((self.pose[:3, :3] - pose[:3, :3]).norm()) / math.sqrt(2)
        return float((self.pose[:3, 3] - pose[:3, 3]).norm()) <= reach and turn <= angle


@dataclass(frozen=True, eq=False)
class LetterboxedView:
    """A photograph's camera letterboxed into a window: the whole photograph, its optical axis at the window's centre.

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
    def fit(camera: Camera, aspect: float) -> LetterboxedView:
        """Letterbox a photograph into the smallest window of this aspect (width over height)."""
        square = with_square_pixels(camera)
        cx, cy = square.principal_point.tolist()
        across, down = 2 * max(cx, square.width - cx), 2 * max(cy, square.height - cy)
        height = math.ceil(max(down, across / aspect))
        width = max(math.ceil(across), round(height * aspect))
        left, top = (
            _rounded_within(width / 2 - cx, width - square.width),
            _rounded_within(height / 2 - cy, height - square.height),
        )
        return LetterboxedView(square, width, height, left, top)

    @property
    def fov(self) -> float:
        """Vertical field of view of the window, in radians."""
        return 2 * math.atan(self.height / 2 / float(self.camera.focal[1]))


def _rounded_within(offset: float, most: int) -> int:
    return max(0, min(round(offset), most))


def with_square_pixels(camera: Camera) -> Camera:
    """The camera resampled along x so that fx = fy."""
    fx, fy = camera.focal.tolist()
    if abs(fx / fy - 1) < SQUARE_TOLERANCE:
        return camera
    return camera.resized(max(1, round(camera.width * fy / fx)), camera.height)


def rotation_quaternion(pose: Float[Tensor, "4 4"]) -> tuple[float, float, float, float]:
    """The rotation of a pose as a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(pose[:3, :3].double().numpy()).as_quat().tolist()
    return w, x, y, z


def fov_and_aspect(camera: Camera) -> tuple[float, float]:
    """Vertical field of view in radians and aspect of a camera's frustum, with its principal point taken as centred."""
    fx, fy = camera.focal.tolist()
    return 2 * math.atan(camera.height / 2 / fy), camera.width / fx / (camera.height / fy)


def subregion(camera: Camera, columns: tuple[int, int], rows: tuple[int, int]) -> Camera:
    """Camera of a rectangle of the image; half-open pixel ranges."""
    corner = camera.principal_point.new_tensor([columns[0], rows[0]])
    return replace(
        camera, principal_point=camera.principal_point - corner, width=columns[1] - columns[0], height=rows[1] - rows[0]
    )


def limit_size(camera: Camera, max_size: int) -> Camera:
    """Camera downscaled to at most ``max_size`` pixels along its longer side."""
    return rescale(camera, min(1.0, max_size / max(camera.width, camera.height)))


def rescale(camera: Camera, scale: float) -> Camera:
    """Camera resized by ``scale``, rounded to whole pixels."""
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)


def nearest_view_index(views: Sequence[View], viewer_camera: ViewerCamera, extent: float) -> int:
    """Index of the view nearest to a camera: distance in scene extents plus angle in radians."""
    poses = torch.stack([view.camera.cam_to_world for view in views])
    distance = (poses[:, :3, 3] - viewer_camera.pose[:3, 3]).norm(dim=1) / extent
    angle = (poses[:, :3, 2] @ viewer_camera.pose[:3, 2]).clamp(-1, 1).acos()
    return int((distance + angle).argmin())
