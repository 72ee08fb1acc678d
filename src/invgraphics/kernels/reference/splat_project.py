"""EWA projection of 3D Gaussians to conic footprints on the screen."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.harmonics import colour
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.types import ALPHA_MIN, COMPENSATION_MIN, Footprints

NEAR = 0.01
"""Primitives whose centre is nearer than this along the optical axis are culled, local units (as in gsplat)."""
MARGIN = 0.3
"""How far beyond the image, in half-images, the Jacobian follows the mean (3DGS clamps at 1.3 times the frustum)."""
ILL_CONDITIONED = 1e-4
"""Ratio of determinant to squared trace below which a footprint without dilation is too thin to invert."""


def splat_project(
    gaussians: Gaussians, camera: Camera, dilation: float = 0.3, antialiased: bool = False
) -> tuple[Footprints, Float[Tensor, "n 3"]]:
    """See `invgraphics.kernels.splat_project`.

    The map from camera axes to (x pixels, y pixels, distance) is replaced by its derivative J at the mean, under which
    the covariance becomes ``J V J^T`` (Zwicker et al. 2002, EWA splatting, equations 29 and 31, by 3DGS's code). With
    ``V = L L^T`` this is ``A A^T``, A = J L.
    """
    mean, in_front = in_camera(gaussians, camera)
    factor = camera.cam_to_world[:3, :3].T @ quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    a = jacobian(mean, camera) @ factor

    xx, xy, yy, det = _covariance(a, dilation)
    opacities = gaussians.opacities * _compensations(a, det) if antialiased else gaussians.opacities
    conics = torch.stack([yy / det, -xy / det, xx / det], dim=1)
    means2d = camera.principal_point + camera.focal * mean[:, :2] / mean[:, 2:]
    with torch.no_grad():
        reach = visible_reach(opacities)
        largest = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()
        box = reach[:, None] * torch.stack([xx, yy], dim=1).sqrt()
        visible = in_front & meets_image(means2d, box, camera)
        radii = torch.where(visible, reach * largest.sqrt(), 0.0)
    return Footprints(means2d, conics, opacities, mean[:, 2], depth_planes_of(mean, a, dilation), radii), colours(
        gaussians, camera
    )


def in_camera(gaussians: Gaussians, camera: Camera) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
    """Means in camera axes, and which of them lie in front of the camera."""
    mean = (gaussians.means - camera.position) @ camera.cam_to_world[:3, :3]
    in_front = mean[:, 2] > NEAR
    # Culled primitives go to a harmless place: their gradients must be zero, not undefined.
    return torch.where(in_front[:, None], mean, mean.new_tensor([0.0, 0.0, 1.0])), in_front


def visible_reach(opacities: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Standard deviations within which a response is visible: o exp(-q/2) >= 1/255 exactly where q <= 2 ln(255 o)."""
    return (2 * torch.log((opacities / ALPHA_MIN).clamp_min(1.0))).sqrt()


def colours(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """Colours towards the camera, cut off at zero."""
    return colour(gaussians.sh, torch.nn.functional.normalize(gaussians.means - camera.position, dim=1))


def jacobian(mean: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3 3"]:
    """Derivative of (x pixels, y pixels, distance from the camera) with respect to the point in camera axes.

    Far outside the image the perspective is so strong that the affine map is worthless and its footprints explode, so
    the first two rows are taken at a direction clamped to the image plus a margin.
    """
    size = camera.focal.new_tensor([camera.width, camera.height])
    margin = MARGIN * 0.5 * size / camera.focal
    lowest = -camera.principal_point / camera.focal - margin
    highest = (size - camera.principal_point) / camera.focal + margin
    z = mean[:, 2]
    slope = torch.minimum(torch.maximum(mean[:, :2] / z[:, None], lowest), highest)
    fx, fy = (camera.focal / z[:, None]).unbind(dim=1)
    zero = torch.zeros_like(z)
    rows = [
        torch.stack([fx, zero, -fx * slope[:, 0]], dim=1),
        torch.stack([zero, fy, -fy * slope[:, 1]], dim=1),
        mean / mean.norm(dim=1, keepdim=True),
    ]
    return torch.stack(rows, dim=1)


def _covariance(a: Float[Tensor, "n 3 3"], dilation: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entries (xx, xy, yy) and determinant of the screen block of ``A A^T + dilation I``.

    The determinant of ``A A^T`` is the squared area spanned by A's rows; xx yy - xy² would cancel for thin splats.
    """
    x, y = a[:, 0], a[:, 1]
    xx, xy, yy = (x * x).sum(dim=1), (x * y).sum(dim=1), (y * y).sum(dim=1)
    area = torch.linalg.cross(x, y).square().sum(dim=1)
    det = area + dilation * (xx + yy) + dilation**2
    return xx + dilation, xy, yy + dilation, det.clamp_min(torch.finfo(det.dtype).tiny)


def _compensations(a: Float[Tensor, "n 3 3"], det: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Opacity compensation that keeps the integral of a filtered footprint of covariance determinant ``det``."""
    *_, area = _covariance(a, 0.0)
    return (area / det).clamp_min(COMPENSATION_MIN**2).sqrt()


def meets_image(means2d: Float[Tensor, "n 2"], box: Float[Tensor, "n 2"], camera: Camera) -> Bool[Tensor, " n"]:
    """Whether the visible ellipse's bounding box overlaps the image.

    The box reaches to response 1/255, at most 3.33 sigma: nothing of the 99% ellipsoid (3.37 sigma) that could be seen is lost.
    """
    size = means2d.new_tensor([camera.width, camera.height])
    overlaps = (means2d + box > 0) & (means2d - box < size) & (box > 0)
    return overlaps.all(dim=1)


def depth_planes_of(mean: Float[Tensor, "n 3"], a: Float[Tensor, "n 3 3"], dilation: float) -> Float[Tensor, "n 3"]:
    """Distance of the maximal response along each pixel's ray, as an affine function of the pixel.

    In (x, y, distance) the primitive is a Gaussian, and for given (x, y) its density peaks at the conditional mean
    ``l + Cov(l, xy) Cov(xy)^-1 (p - mean)``. Screen dilation is no part of the primitive's shape; it is left out unless
    the footprint is then too thin to invert (a disc seen edge-on).
    """
    xx, xy, yy, det = _covariance(a, 0.0)
    thin = det < ILL_CONDITIONED * (xx + yy).square()
    blurred = _covariance(a, max(dilation, torch.finfo(a.dtype).eps))
    xx, xy, yy, det = (torch.where(thin, wide, own) for wide, own in zip(blurred, (xx, xy, yy, det), strict=True))
    along_x, along_y = (a[:, 2] * a[:, 0]).sum(dim=1), (a[:, 2] * a[:, 1]).sum(dim=1)
    slope_x = (along_x * yy - along_y * xy) / det
    slope_y = (along_y * xx - along_x * xy) / det
    return torch.stack([mean.norm(dim=1), slope_x, slope_y], dim=1)


def depth_plane_gradients(
    gaussians: Gaussians, camera: Camera, dilation: float, grad_planes: Float[Tensor, "n 3"], radii: Float[Tensor, " n"]
) -> tuple[Tensor | None, ...]:
    """Gradients through the depth planes, which only depth losses have: of means, quaternions, scales, sh and pose."""
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_() for x in (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.sh)]
        means, quaternions, scales, sh = leaves
        pose = camera.cam_to_world.detach().requires_grad_()
        again = Gaussians(means, quaternions, scales, gaussians.opacities.detach(), sh)
        footprints, _ = splat_project(again, camera.moved(pose), dilation)
        visible = torch.where(radii[:, None] > 0, grad_planes, 0.0)
        return torch.autograd.grad(footprints.depth_planes, [*leaves, pose], visible, allow_unused=True)
