"""Lens distortion, removed once when a scene is loaded, so that every camera after that is a pinhole."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.errors import InputError

WIDEST = 2.0
"""Largest |x/z| and |y/z| kept of a fisheye picture (a field of view of 127°): beyond it a pinhole image is mostly stretch."""


@dataclass(frozen=True)
class Lens:
    """A lens in COLMAP's terms.

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
        """The lens as a ``pycolmap.Camera``.

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
        """Whether there is nothing to remove."""
        return self.colmap().is_undistorted()


@dataclass(frozen=True, eq=False)
class Straight:
    """How to make a pinhole picture of the same size from a distorted one.

    Attributes:
        focal: focal lengths (fx, fy) of the pinhole, pixels.
        centre: its principal point, pixels.
        grid: for each pixel of the pinhole picture where to look in the distorted one, in [-1, 1] from border to border.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    grid: Float[torch.Tensor, "h w 2"]


@lru_cache(maxsize=2)
def straighten(lens: Lens) -> Straight:
    """The pinhole that shows the largest part of the photograph without any blank pixel, at the photograph's size.

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


def _inner_rectangle(camera: Any, width: int, height: int) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of a rectangle on the plane z = 1 that the photograph covers."""
    # Half a pixel inside the border, so that bilinear interpolation never asks for a pixel that is not there.
    x, y = np.linspace(0.5, width - 0.5, 129), np.linspace(0.5, height - 0.5, 129)
    sides = [(np.full_like(y, x[0]), y), (np.full_like(y, x[-1]), y), (x, np.full_like(x, y[0])), (x, np.full_like(x, y[-1]))]
    limits = []
    for side, (axis, sign) in zip(sides, [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)], strict=True):
        border = np.stack(side, axis=1)
        plane = camera.cam_from_img(border)
        # COLMAP gives back nonsense where its iteration fails (a fisheye beyond 180°): believe only what maps back.
        back = camera.img_from_cam(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
        believable = np.abs(back - border).max(axis=1) < 0.01
        reach = np.append(sign * plane[believable, axis], WIDEST)
        limits.append(sign * reach.min())
    if not (limits[0] < limits[1] and limits[2] < limits[3]):
        raise InputError(f"The distortion parameters of a {camera.model_name} camera fold its picture.", "Check their signs.")
    return limits[0], limits[1], limits[2], limits[3]


def undistort(values: Float[np.ndarray, "h w c"], straight: Straight) -> Float[np.ndarray, "h w c"]:
    """Resample a picture (premultiplied where it has alpha) bilinearly to the pinhole."""
    source = torch.from_numpy(values).permute(2, 0, 1)[None]
    result = torch.nn.functional.grid_sample(source, straight.grid[None], align_corners=False, padding_mode="border")
    return result[0].permute(1, 2, 0).numpy()
