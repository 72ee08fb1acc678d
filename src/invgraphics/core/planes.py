"""Multi-plane images: fronto-parallel RGBA layers before a reference camera, and their homographies to other cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core.camera import Camera

Basis = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n k"]]
"""Basis functions of the unit viewing direction, in the axes of the reference camera."""

WIDEST = 60.0
"""Most degrees between a camera's optical axis and the mean of all, for cameras that look one way."""


@dataclass(frozen=True, eq=False)
class Planes:
    """A multi-plane image (Szeliski and Golland 1999; Zhou et al. 2018), after its activations.

    Plane i lies at z = ``depths[i]`` in the axes of the reference camera, in whose picture its texels are pixels.

    Attributes:
        camera: reference camera; its width and height are those of ``rgb`` and ``alpha``.
        depths: distances along its optical axis, local units, ascending: nearest first.
        rgb: straight colour in the scene's colour space.
        alpha: opacity in [0, 1] of a ray through the texel.
        coefficients: of the view-dependent colour added to ``rgb``, one for each basis function (NeX, equation 3); over the
            same area as ``rgb``, in texels of their own size. ``None`` for none.
        basis: the basis functions; ``None`` exactly where there are no coefficients.
    """

    camera: Camera
    depths: Float[Tensor, " p"]
    rgb: Float[Tensor, "p 3 h w"]
    alpha: Float[Tensor, "p h w"]
    coefficients: Float[Tensor, "p k 3 i j"] | None = None
    basis: Basis | None = None

    def __len__(self) -> int:
        return len(self.depths)

    def homographies(self, camera: Camera) -> Float[Tensor, "p 3 3"]:
        """Homographies from ``camera``'s image points to those of the reference camera, one for each plane."""
        return homographies(self.camera, self.depths, camera)


def homographies(reference: Camera, depths: Float[Tensor, " p"], camera: Camera) -> Float[Tensor, "p 3 3"]:
    """Plane-induced homographies from image points of ``camera`` to those of ``reference``, differentiable in both poses.

    ``H_i = K_r (c e_zᵀ + (d_i - c_z) I) R K⁻¹`` with ``c`` the centre of ``camera`` and ``R`` its axes, both in the axes of
    ``reference`` (Hartley and Zisserman 2004, equation 13.2, for planes z = d). They are scaled such that the third homogeneous
    coordinate of an image point's map is ``d_i r_z``, where ``r_z`` is the z of its ray in the axes of ``reference``.

    Args:
        reference: camera in whose axes the planes are fronto-parallel.
        depths: of the planes, along its optical axis.
        camera: any other camera.
    """
    axes = reference.cam_to_world[:3, :3]
    rotation = axes.T @ camera.cam_to_world[:3, :3]
    centre = axes.T @ (camera.position - reference.position)
    along_z = torch.zeros(3, 3, dtype=centre.dtype, device=centre.device)
    along_z = torch.cat([along_z[:, :2], centre[:, None]], dim=1)
    eye = torch.eye(3, dtype=centre.dtype, device=centre.device)
    offsets = (depths - centre[2])[:, None, None]
    return _intrinsics(reference) @ (along_z + offsets * eye) @ (rotation @ _inverse_intrinsics(camera))


def homographies_to(reference: Camera, depths: Float[Tensor, " p"], camera: Camera) -> Float[Tensor, "p 3 3"]:
    """Homographies from ``reference``'s image points to those of ``camera``, one for each plane: inverses of `homographies`.

    The third coordinate is the depth of the plane's point along the axis of ``camera``, positive before it.
    """
    moved = camera.world_to_cam @ reference.cam_to_world
    origin = torch.cat([torch.zeros_like(moved[:3, :2]), moved[:3, 3:]], dim=1)
    return _intrinsics(camera) @ (moved[:3, :3] @ (depths[:, None, None] * _inverse_intrinsics(reference)) + origin)


def _intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    """The calibration matrix K, from camera axes to homogeneous image points."""
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)


def _inverse_intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([1 / fx, zero, -cx / fx, zero, 1 / fy, -cy / fy, zero, zero, one]).view(3, 3)


def inverse_depths(near: float, far: float, count: int) -> Float[Tensor, " p"]:
    """Depths from ``near`` to ``far``, evenly spaced in 1 / depth: a step between planes is the same parallax everywhere."""
    return 1 / torch.linspace(1 / near, 1 / far, count, dtype=torch.float64)


def widest_angle(cameras: Sequence[Camera]) -> float:
    """Largest angle in degrees between a camera's optical axis and the mean axis of all; 180 where the mean vanishes."""
    axes = torch.stack([camera.cam_to_world[:3, 2] for camera in cameras]).double()
    mean = axes.mean(dim=0)
    if float(mean.norm()) < 1e-6:
        return 180.0
    return math.degrees(math.acos(min(1.0, max(-1.0, float((axes @ normalize(mean, dim=0)).min())))))


def mean_camera(cameras: Sequence[Camera]) -> Camera:
    """Camera at the mean position, in the mean orientation and with the mean lens of ``cameras``, which look one way."""
    poses = torch.stack([camera.cam_to_world for camera in cameras]).double()
    forward = normalize(poses[:, :3, 2].mean(dim=0), dim=0)
    right = torch.linalg.cross(poses[:, :3, 1].mean(dim=0), forward)
    right = normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose[:3, 3] = poses[:, :3, 3].mean(dim=0)
    width, height = (round(sum(getattr(camera, edge) for camera in cameras) / len(cameras)) for edge in ("width", "height"))
    scaled = [camera.resized(width, height) for camera in cameras]
    focal, centre = (
        torch.stack([getattr(camera, name) for camera in scaled]).double().mean(dim=0) for name in ("focal", "principal_point")
    )
    like = cameras[0].focal
    return Camera(pose.to(like), focal.to(like), centre.to(like), width, height)


def widened(reference: Camera, cameras: Sequence[Camera], span: tuple[float, float], most: float) -> Camera:
    """``reference`` with its picture widened to hold what ``cameras`` see of the planes at both depths of ``span``.

    Args:
        reference: fronto-parallel to the planes.
        cameras: whose pictures are to be covered.
        span: nearest and farthest depth.
        most: largest margin, in widths or heights of the picture, on either side.
    """
    size = reference.focal.new_tensor([reference.width, reference.height]).double()
    lo, hi = torch.zeros_like(size), size.clone()
    depths = torch.tensor(span, dtype=torch.float64)
    for camera in cameras:
        wide, high = float(camera.width), float(camera.height)
        corners = torch.tensor([[0, 0, 1], [wide, 0, 1], [0, high, 1], [wide, high, 1]], dtype=torch.float64)
        places = corners @ homographies(reference.to(torch.float64), depths, camera.to(torch.float64)).transpose(1, 2)
        ahead = places[..., 2] > 0
        seen = (places[..., :2] / places[..., 2:])[ahead]
        if len(seen):
            lo, hi = torch.minimum(lo, seen.amin(dim=0)), torch.maximum(hi, seen.amax(dim=0))
    lo, hi = (lo.clamp_min(-most * size)).floor(), (hi.clamp_max((1 + most) * size)).ceil()
    width, height = (int(edge) for edge in (hi - lo).tolist())
    principal_point = reference.principal_point - lo.to(reference.principal_point)
    return replace(reference, principal_point=principal_point, width=width, height=height)


def warp(
    layers: Float[Tensor, "p c i j"], maps: Float[Tensor, "p 3 3"], size: tuple[int, int], extent: tuple[int, int] | None = None
) -> tuple[Float[Tensor, "p c h w"], Float[Tensor, "p h w"], Float[Tensor, "p h w"]]:
    """Sample layers bilinearly at the images of a picture's pixel centres under one homography each.

    Args:
        layers: what is sampled; texel centres are at halves, as pixels are. Beyond the outermost ones their values continue.
        maps: from image points of the picture to those of the layers.
        size: width and height of the picture in pixels.
        extent: width and height of the layers in the units that ``maps`` leads to; ``None``: their texels.

    Returns:
        Samples; 1.0 where a point lies within its layer and before it in homogeneous coordinates, else 0; and the points' third
        homogeneous coordinate.
    """
    width, height = size
    x, y = (torch.arange(edge, dtype=maps.dtype, device=maps.device) + 0.5 for edge in (width, height))
    across, down, offset = (maps[:, :, None, None, k] for k in range(3))
    points = across * x + down * y[:, None] + offset
    z = points[:, 2]
    safe = torch.where(z > 0, z, 1.0)
    wide, high = extent or (layers.shape[3], layers.shape[2])
    u, v = points[:, 0] / safe * (2 / wide) - 1, points[:, 1] / safe * (2 / high) - 1
    inside = (z > 0) & (u.abs() <= 1) & (v.abs() <= 1)
    grid = torch.stack([u, v], dim=-1)
    values = torch.nn.functional.grid_sample(layers, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values, inside.to(values.dtype), z
