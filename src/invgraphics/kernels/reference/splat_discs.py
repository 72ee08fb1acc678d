"""Perspective-correct projection of flat discs to the screen (2DGS, Huang et al. 2024)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.reference.splat_project import (
    colours,
    depth_planes_of,
    in_camera,
    jacobian,
    meets_image,
    visible_reach,
)
from invgraphics.kernels.types import Footprints

EDGE_ON = 1e-6
"""Volume spanned by a disc's axes and centre in homogeneous pixels, over the product of their lengths, below which it is seen
edge-on."""


def splat_project_discs(gaussians: Gaussians, camera: Camera, dilation: float = 0.5) -> tuple[Footprints, Float[Tensor, "n 3"]]:
    """See `invgraphics.kernels.splat_project_discs`.

    A point (u, v) of the disc, in standard deviations, lies on the screen at M (u, v, 1) in homogeneous pixels, whose columns
    are the images of the disc's axes and centre (2DGS, equation 7). M's inverse takes a pixel to where its ray meets the disc.
    """
    mean, in_front = in_camera(gaussians, camera)
    turned = camera.cam_to_world[:3, :3].T @ quaternion_to_matrix(gaussians.quaternions)
    axes = turned[:, :, :2] * gaussians.scales[:, None, :2]
    means2d = camera.principal_point + camera.focal * mean[:, :2] / mean[:, 2:]
    # The centre's column is written with its screen position, so that the screen-space gradient arrives at it.
    centre = mean[:, 2:] * torch.nn.functional.pad(means2d, (0, 1), value=1.0)
    matrix = torch.cat([homogeneous(axes, camera), centre[:, :, None]], dim=2)
    with torch.no_grad():
        reach = visible_reach(gaussians.opacities)
        weights = torch.stack([reach.square(), reach.square(), -torch.ones_like(reach)], dim=1)
        radius = torch.maximum(half_width(matrix, weights, means2d, camera), reach * dilation**0.5)
        visible = in_front & meets_image(means2d, radius[:, None].expand(-1, 2), camera)
    depth_planes = depth_planes_of(mean, jacobian(mean, camera) @ torch.nn.functional.pad(axes, (0, 1)), dilation)
    footprints = Footprints(
        means2d=means2d,
        conics=torch.zeros_like(mean),
        opacities=gaussians.opacities,
        depths=mean[:, 2],
        depth_planes=depth_planes,
        radii=torch.where(visible, radius, 0.0),
        homography=_inverse(matrix),
        blur=torch.full_like(means2d[:, 0], dilation) if dilation else None,
    )
    return footprints, colours(gaussians, camera)


def homogeneous(directions: Float[Tensor, "n 3 k"], camera: Camera) -> Float[Tensor, "n 3 k"]:
    """Directions in camera axes as homogeneous pixels."""
    x, y, z = directions.unbind(dim=1)
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    return torch.stack([fx * x + cx * z, fy * y + cy * z, z], dim=1)


def _inverse(matrix: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Inverse by cross products; zero where a disc is seen edge-on within rounding, so that every ray misses it."""
    u, v, w = matrix.unbind(dim=2)
    rows = [torch.linalg.cross(v, w), torch.linalg.cross(w, u), torch.linalg.cross(u, v)]
    det = (u * rows[0]).sum(dim=1)
    # Beyond that angle the inverse is rounding error, and so large that products of its gradients overflow to NaN.
    flat = det.abs() < EDGE_ON * u.norm(dim=1) * v.norm(dim=1) * w.norm(dim=1)
    inverse = torch.stack(rows, dim=1) / torch.where(flat, 1.0, det)[:, None, None]
    return torch.where(flat[:, None, None], 0.0, inverse)


def half_width(
    matrix: Float[Tensor, "n 3 k"], weights: Float[Tensor, "n k"], means2d: Float[Tensor, "n 2"], camera: Camera
) -> Float[Tensor, " n"]:
    """Half-width of a square around ``means2d`` that holds the image of a disc or an ellipsoid.

    That image is a conic with dual D = M diag(w) M^T, whose axis-parallel tangents give its box. What reaches behind the camera
    has none and may be seen anywhere.

    Args:
        matrix: M, the axes and the centre in homogeneous pixels.
        weights: squared reach along each axis, and -1 for the centre.
        means2d: the centre's image, in pixels.
        camera: camera that projects them.
    """
    dual = (matrix * weights[:, None, :]) @ matrix.transpose(1, 2)
    bounded = dual[:, 2, 2] < 0
    last = torch.where(bounded, dual[:, 2, 2], -1.0)
    middle = dual[:, :2, 2] / last[:, None]
    spread = (middle.square() - dual.diagonal(dim1=1, dim2=2)[:, :2] / last[:, None]).clamp_min(0.0).sqrt()
    farthest = ((middle - means2d).abs() + spread).amax(dim=1)
    size = means2d.new_tensor([camera.width, camera.height])
    everywhere = torch.maximum(means2d.abs(), (size - means2d).abs()).amax(dim=1)
    return torch.where(bounded, farthest, everywhere)
