"""The one camera: a pinhole with OpenCV axes and its principal point in pixels; and the size of pixels in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.errors import InputError

CHUNK = 1 << 15
"""Points whose distances to all cameras are held at once."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera (see CONVENTIONS.md). All tensors may carry gradients, so poses can be optimised.

    Attributes:
        cam_to_world: rigid transform whose columns are the camera's +x (right), +y (down), +z (forward) and position.
        focal: focal lengths (fx, fy) in pixels.
        principal_point: (cx, cy) in pixels; the first pixel's centre is (0.5, 0.5).
        width: image width in pixels.
        height: image height in pixels.
    """

    cam_to_world: Float[Tensor, "4 4"]
    focal: Float[Tensor, 2]
    principal_point: Float[Tensor, 2]
    width: int
    height: int

    def __post_init__(self) -> None:
        for name, shape in (("cam_to_world", "(4, 4)"), ("focal", "(2,)"), ("principal_point", "(2,)")):
            if not isinstance(value := getattr(self, name), Tensor):
                raise InputError(f"The camera's '{name}' is {type(value).__name__}.", f"Expected: a tensor of shape {shape}.")

    @property
    def position(self) -> Float[Tensor, 3]:
        """The camera's centre of projection, in the scene's frame."""
        return self.cam_to_world[:3, 3]

    @property
    def world_to_cam(self) -> Float[Tensor, "4 4"]:
        """The inverse pose. Rigid by contract, so the rotation is transposed rather than inverted."""
        rotation = self.cam_to_world[:3, :3].T
        top = torch.cat([rotation, -(rotation @ self.position)[:, None]], dim=1)
        return torch.cat([top, self.cam_to_world[3:]], dim=0)

    def pixel_centres(self) -> Float[Tensor, "h w 2"]:
        """Image coordinates (x, y) of every pixel centre."""
        like: Any = {"device": self.focal.device, "dtype": self.focal.dtype}
        y, x = torch.meshgrid(torch.arange(self.height, **like) + 0.5, torch.arange(self.width, **like) + 0.5, indexing="ij")
        return torch.stack([x, y], dim=-1)

    def pixel_centres_of(self, flat: Int[Tensor, " n"]) -> Float[Tensor, "n 2"]:
        """Image coordinates (x, y) of the centres of the pixels with these flat indices, row by row; see `pixel_of`."""
        return torch.stack([flat % self.width, flat // self.width], dim=1) + 0.5

    def rays(self, pixels: Float[Tensor, "n 2"] | None = None, view: int = -1) -> Rays:
        """Rays through image points.

        Args:
            pixels: image coordinates (x, y); ``None`` means every pixel centre, row by row.
            view: training-view index to record in the rays.
        """
        pixels = self.pixel_centres().reshape(-1, 2) if pixels is None else pixels
        return _rays(pixels, self.cam_to_world, self.focal, self.principal_point, view)

    def ray(self, pixel: tuple[int, int]) -> Rays:
        """The one ray through the centre of ``pixel``: column and row, from 0."""
        return self.rays(self.focal.new_tensor([pixel]) + 0.5)

    def project(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
        """Image coordinates (x, y) of world points and their depth along the optical axis (z in camera axes).

        Points with z <= 0 are behind the camera and their image coordinates mean nothing.
        """
        in_camera = (points - self.position) @ self.cam_to_world[:3, :3]
        z = in_camera[:, 2]
        return self.principal_point + self.focal * in_camera[:, :2] / z[:, None], z

    def pixel_of(self, points: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, " n"], Int[Tensor, " n"]]:
        """Find the pixel into which each point is projected: mask of points in the picture, and flat indices, 0 for others."""
        place, z = self.project(points)
        column, row = place.nan_to_num(-1).floor().long().unbind(dim=1)
        inside = (z > 0) & (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return inside, torch.where(inside, row * self.width + column, 0)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same photograph resampled to ``width`` x ``height``."""
        scale = self.focal.new_tensor([width / self.width, height / self.height])
        return replace(self, focal=self.focal * scale, principal_point=self.principal_point * scale, width=width, height=height)

    def moved(self, cam_to_world: Float[Tensor, "4 4"]) -> Camera:
        """The same lens at another pose."""
        return replace(self, cam_to_world=cam_to_world)

    def to(self, *args: Any) -> Camera:
        """Move or cast all tensors."""
        pose, focal, principal_point = (values.to(*args) for values in (self.cam_to_world, self.focal, self.principal_point))
        return replace(self, cam_to_world=pose, focal=focal, principal_point=principal_point)


def rays_through(cameras: Sequence[Camera], camera: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"], view: Tensor) -> Rays:
    """Rays of several cameras at once, which is faster than camera by camera.

    Args:
        cameras: the cameras.
        camera: which of them each ray belongs to.
        pixels: image coordinates (x, y).
        view: training-view index to record for each ray.
    """
    names = "cam_to_world", "focal", "principal_point"
    pose, focal, centre = (torch.stack([getattr(c, name) for c in cameras])[camera] for name in names)
    return _rays(pixels, pose, focal, centre, view)


def _rays(pixels: Float[Tensor, "n 2"], pose: Tensor, focal: Tensor, centre: Tensor, view: Tensor | int) -> Rays:
    """Rays from poses (4, 4) or (n, 4, 4), focal lengths and principal points, each (2,) or (n, 2)."""
    plane = (pixels - centre) / focal
    in_camera = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1)
    length = in_camera.norm(dim=1, keepdim=True)
    rotation, position = pose[..., :3, :3], pose[..., :3, 3]
    unit = in_camera / length
    directions = unit @ rotation.T if pose.ndim == 2 else (rotation @ unit[:, :, None])[:, :, 0]
    # mip-NeRF (§3.1) sets the cone's radius at distance 1 to the pixel's width times 2/sqrt(12).
    radius = (2 / 12**0.5) / focal.mean(dim=-1) / length[:, 0]
    return Rays.make(position.expand(len(pixels), 3), directions, radius, view)


def pixel_sizes(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Size of a pixel at each point, local units: the smallest distance over focal length of any camera, in view or not.

    A lower bound of what any of the cameras can resolve there, from distances alone.
    """
    position = torch.stack([camera.position for camera in cameras]).to(points)
    focal = torch.stack([camera.focal.max() for camera in cameras]).to(points)
    sizes = [_nearest(part, position, focal) for part in points.split(CHUNK)]
    return torch.cat(sizes) if sizes else points[:, 0]


def _nearest(points: Float[Tensor, "k 3"], position: Float[Tensor, "c 3"], focal: Float[Tensor, " c"]) -> Float[Tensor, " k"]:
    """Smallest distance over focal length, by |p - c|² = |p|² - 2 p·c + |c|²."""
    squared = points.square().sum(dim=1, keepdim=True) - 2 * points @ position.T + position.square().sum(dim=1)
    return (squared.clamp_min(0.0) / focal.square()).amin(dim=1).sqrt()


@torch.no_grad()
def pixel_size(bounds: Bounds, cameras: Sequence[Camera]) -> float:
    """Median over the bounds' box of `pixel_sizes`, local units."""
    axis = torch.linspace(-1, 1, 8)
    points = bounds.centre + torch.cartesian_prod(axis, axis, axis).to(bounds.half) * bounds.half
    return float(pixel_sizes(points, cameras).median())


def pixel_limit(bounds: Bounds, cameras: Sequence[Camera]) -> float:
    """Vertices along the edge of a cubic lattice that are a `pixel_size` apart.

    In contracted space the box has half of the lattice's edge.
    """
    edge = float((2 * bounds.half).prod()) ** (1 / 3) * (2 if bounds.space == "contracted" else 1)
    return edge / pixel_size(bounds, cameras)
