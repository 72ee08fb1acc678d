"""Lens distortion, removed once when a scene is loaded, so that every camera after that is a pinhole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.errors import InputError

WIDEST = 2.0
"""Largest |x/z| and |y/z| kept of a fisheye picture (a field of view of 127°): beyond it a pinhole image is mostly stretch."""

MOST_STRETCH = 100.0
"""Ratio of the areas of pixels within an undistorted picture; that of a fisheye is 9 at `WIDEST`."""
SHRINKS = 60
"""How often a rectangle that a lens folds is made 5% smaller before the lens is refused."""


@dataclass(frozen=True)
class Lens:
    """Camera model with lens distortion, in COLMAP's terms.

    Attributes:
        model: name of a COLMAP camera model, for instance ``OPENCV``.
        params: its parameters in COLMAP's order (focal lengths and principal point first), pixels.
        width: width in pixels of the photographs that the parameters are for.
        height: their height.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    def colmap(self) -> Any:
        """Convert the lens to a ``pycolmap.Camera``.

        Raises:
            InputError: the model is unknown, is no perspective camera, or has another number of parameters.
        """
        from invgraphics.scenes.colmap_library import pycolmap

        known = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        if self.model not in known:
            raise InputError(f"'{self.model}' is not a known camera model.", f"Known models: {', '.join(known)}.")
        camera = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
        if camera.is_spherical() or not camera.verify_params():
            raise InputError(f"A camera of model {self.model} with {len(self.params)} parameters cannot be made a pinhole.")
        return camera

    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion; one that projects angles (a fisheye) always has, whatever its parameters."""
        camera = self.colmap()
        return "FISHEYE" not in self.model and camera.is_undistorted()


@dataclass(frozen=True, eq=False)
class Straight:
    """Resampling map from a distorted picture to a pinhole's of equal size.

    Attributes:
        focal: focal lengths (fx, fy) of the pinhole, pixels.
        principal_point: pixels.
        grid: for each pixel of the pinhole picture where to look in the distorted one, in [-1, 1] from border to border.
    """

    focal: tuple[float, float]
    principal_point: tuple[float, float]
    grid: Float[torch.Tensor, "h w 2"]


@lru_cache(maxsize=2)
def straighten(lens: Lens) -> Straight:
    """Compute the pinhole with the largest field of view without blank pixels, at the photograph's size.

    The border of the photograph is mapped to the plane z = 1; the pinhole's viewport is the rectangle inside that curve, cut
    to the photograph's aspect ratio. The ratio of the focal lengths is kept.
    """
    camera = lens.colmap()
    width, height = lens.width, lens.height
    left, right, top, bottom = _inner_rectangle(camera, width, height)
    fx, fy = camera.focal_length_x, camera.focal_length_y
    zoom = max(width / (fx * (right - left)), height / (fy * (bottom - top)))
    focal = (fx * zoom, fy * zoom)
    centre = (width / 2 - focal[0] * (left + right) / 2, height / 2 - focal[1] * (top + bottom) / 2)

    x = (np.arange(width) + 0.5 - centre[0]) / focal[0]
    y = (np.arange(height) + 0.5 - centre[1]) / focal[1]
    plane = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1)
    pixels = camera.img_from_cam(plane.reshape(-1, 3)).reshape(height, width, 2)
    grid = torch.from_numpy((pixels * (2 / width, 2 / height) - 1).astype(np.float32))
    return Straight(focal, centre, grid)


def straightening_obstacle(lens: Lens) -> str:
    """Why `straighten` refuses a lens, in a sentence; empty where it does not. Takes milliseconds."""
    try:
        _inner_rectangle(lens.colmap(), lens.width, lens.height)
    except InputError as error:
        return error.sentence
    return ""


def _inner_rectangle(camera: Any, width: int, height: int) -> tuple[float, float, float, float]:
    """Rectangle (left, right, top, bottom) on the plane z = 1 that the photograph covers."""
    # Half a pixel inside the border, so that bilinear interpolation never reads a pixel outside.
    x, y = np.linspace(0.5, width - 0.5, 129), np.linspace(0.5, height - 0.5, 129)
    sides = [(np.full_like(y, x[0]), y), (np.full_like(y, x[-1]), y), (x, np.full_like(x, y[0])), (x, np.full_like(x, y[-1]))]
    limits, trusted = [], 0
    for side, (axis, sign) in zip(sides, [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)], strict=True):
        border = np.stack(side, axis=1)
        plane = camera.cam_from_img(border)
        # COLMAP gives back nonsense where its iteration fails (a fisheye beyond 180°): believe only what maps back.
        back = camera.img_from_cam(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
        believable = np.abs(back - border).max(axis=1) < 0.01
        trusted += int(believable.sum())
        reach = plane[believable, axis] * sign if believable.any() else [_valid_extent(camera, axis, sign)]
        limits.append(sign * min(float(np.min(reach)), WIDEST))
    for _ in range(SHRINKS):
        if limits[0] < limits[1] and limits[2] < limits[3] and (areas := _areas(camera, limits)).min() > 0:
            break
        limits = [0.95 * limit for limit in limits]
    else:
        raise _folded_error(camera)
    # Without any border there must at least be a picture up to WIDEST, as of a fisheye beyond 180 degrees.
    if not (trusted or min(map(abs, limits)) == WIDEST):
        raise _folded_error(camera)
    if areas.max() > MOST_STRETCH * areas.min():
        raise InputError(
            f"The distortion parameters of a {camera.model_name} camera smear its picture: the areas of its pixels differ "
            f"{areas.max() / areas.min():.2g} times.",
            "Check the order and the units of the parameters.",
        )
    return limits[0], limits[1], limits[2], limits[3]


def _valid_extent(camera: Any, axis: int, sign: float) -> float:
    """Largest distance from the optical axis along x or y on z = 1 with a monotonic projection; up to `WIDEST`."""
    plane = np.zeros((257, 3))
    plane[:, axis], plane[:, 2] = sign * np.linspace(0, WIDEST, 257), 1
    growing = sign * np.diff(camera.img_from_cam(plane)[:, axis]) > 0  # not of NaN either
    return float(abs(plane[-1 if growing.all() else int(growing.argmin()), axis]))


def _areas(camera: Any, limits: Sequence[float]) -> Float[np.ndarray, " n"]:
    """Determinant of the projection's Jacobian on a lattice in a rectangle; -1 where it is not finite."""
    left, right, top, bottom = limits
    corners = np.stack([*np.meshgrid(np.linspace(left, right, 33), np.linspace(top, bottom, 33)), np.ones((33, 33))], axis=-1)
    step = 1e-4 * min(right - left, bottom - top)
    offsets = np.array([[0.0, 0, 0], [step, 0, 0], [0, step, 0]])
    origin, along, down = (camera.img_from_cam(corners.reshape(-1, 3) + offset) for offset in offsets)
    along, down = along - origin, down - origin
    area = along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0]
    return np.where(np.isfinite(area), area, -1.0)


def _folded_error(camera: Any) -> InputError:
    return InputError(f"The distortion parameters of a {camera.model_name} camera fold its picture.", "Check their signs.")


def undistort(values: Float[np.ndarray, "h w c"], straight: Straight) -> Float[np.ndarray, "h w c"]:
    """Resample a picture bilinearly to the pinhole.

    Args:
        values: distorted picture, colours premultiplied where it has alpha.
        straight: resampling map (see `straighten`), for a picture of this size.
    """
    source = torch.from_numpy(values).permute(2, 0, 1)[None]
    result = torch.nn.functional.grid_sample(source, straight.grid[None], align_corners=False, padding_mode="border")
    return result[0].permute(1, 2, 0).numpy()
