"""Rendering of Gaussians as opaque ellipsoids, for inspection of a fit; not differentiable."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Camera, Gaussians, Rendering
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.reference.splat_discs import half_width, homogeneous
from invgraphics.kernels.reference.splat_project import colours, in_camera
from invgraphics.kernels.reference.splat_raster import over_tiles
from invgraphics.kernels.types import Footprints

TILE = 16
VISIBLE = 0.05
"""Gaussians of less opacity are left out: most of them are about to be pruned, and they would hide the others."""
AMBIENT = 0.35
"""Brightness of a surface seen from the side, as a share of one that faces the camera."""


@torch.no_grad()
def draw_ellipsoids(gaussians: Gaussians, camera: Camera, reach: float = 1.0) -> Rendering:
    """Draw each Gaussian's surface of ``reach`` standard deviations, opaque and lit from the camera.

    Args:
        gaussians: activated primitives.
        camera: pinhole camera.
        reach: size of the ellipsoids.

    Returns:
        A picture whose alpha is 0 or 1, with exact depth and normals.
    """
    mean, in_front = in_camera(gaussians, camera)
    axes = camera.cam_to_world[:3, :3].T @ quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :] * reach
    # An ellipsoid that reaches the camera's plane is left out: it would cover everything.
    clear = mean[:, 2] > axes[:, 2].norm(dim=1)
    keep = (in_front & clear & (gaussians.opacities >= VISIBLE)).nonzero()[:, 0]
    mean, axes = mean[keep], axes[keep]
    rgb = colours(gaussians, camera)[keep]
    inside_out = torch.linalg.inv(axes)

    def paint(near: Int[Tensor, " k"], pixels: Float[Tensor, "p 2"]) -> Float[Tensor, "p 8"]:
        plane = (pixels - camera.principal_point) / camera.focal
        rays = torch.nn.functional.normalize(torch.nn.functional.pad(plane, (0, 1), value=1.0), dim=1)
        return _nearest(rays, mean[near], inside_out[near], rgb[near])

    sums = over_tiles(_bounding_squares(mean, axes, camera), (camera.width, camera.height), TILE, paint)
    normal = sums[..., 5:] @ camera.cam_to_world[:3, :3].T
    return Rendering(sums[..., :3], sums[..., 3], sums[..., 4], normal)


def _nearest(
    rays: Float[Tensor, "p 3"], mean: Float[Tensor, "k 3"], inside_out: Float[Tensor, "k 3 3"], rgb: Float[Tensor, "k 3"]
) -> Float[Tensor, "p 8"]:
    """Colour, alpha, distance and normal (camera axes) of the first ellipsoid on each ray through the origin."""
    blank = torch.cat([torch.zeros(4), torch.tensor([torch.inf]), torch.zeros(3)]).to(rays)
    if len(mean) == 0:
        return blank.expand(len(rays), 8)
    # In coordinates in which the ellipsoid is the unit sphere: |o + t d| = 1.
    o = -(inside_out @ mean[:, :, None])[:, :, 0]
    d = torch.einsum("kij,pj->pki", inside_out, rays)
    a, b, c = d.square().sum(dim=2), (d * o).sum(dim=2), o.square().sum(dim=1) - 1
    discriminant = b * b - a * c
    t = torch.where(discriminant > 0, (-b - discriminant.clamp_min(0).sqrt()) / a, torch.inf)
    t = torch.where(t > 0, t, torch.inf)
    distance, which = t.min(dim=1)
    rows = torch.arange(len(rays), device=rays.device)
    on_sphere = o[which] + torch.where(torch.isfinite(distance), distance, 0.0)[:, None] * d[rows, which]
    normal = torch.nn.functional.normalize((on_sphere[:, None, :] @ inside_out[which])[:, 0], dim=1)
    light = AMBIENT + (1 - AMBIENT) * -(normal * rays).sum(dim=1, keepdim=True).clamp(-1, 0)
    drawn = torch.cat([rgb[which].clamp(0, 1) * light, torch.ones_like(light), distance[:, None], normal], dim=1)
    return torch.where(torch.isfinite(distance)[:, None], drawn, blank)


def _bounding_squares(mean: Float[Tensor, "n 3"], axes: Float[Tensor, "n 3 3"], camera: Camera) -> Footprints:
    """Screen-space bounding squares of the ellipsoids, for `over_tiles`."""
    n = len(mean)
    means2d = camera.principal_point + camera.focal * mean[:, :2] / mean[:, 2:]
    image = homogeneous(torch.cat([axes, mean[:, :, None]], dim=2), camera)
    weights = torch.tensor([1.0, 1.0, 1.0, -1.0]).to(mean).expand(n, 4)
    radii = half_width(image, weights, means2d, camera)
    zero = mean.new_zeros(n, 3)
    return Footprints(means2d, zero, zero[:, 0], mean[:, 2], zero, radii.clamp_min(1.0))
