"""Rasterisation of triangle meshes by homogeneous edge functions, and interpolation between their corners."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.kernels.types import Fragments

PAIRS = 1 << 20
"""Pairs of a triangle and a pixel that are tested together."""
NEAREST_PLANE = 1e-9
"""Depth along the optical axis before which nothing is rasterised, local units."""


def mesh_rasterise(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    interval: tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]] | None = None,
) -> Fragments:
    """Nearest triangles at pixel centres, in double precision: every triangle is tested at the pixels of its bounding box."""
    with torch.no_grad():
        corners = _in_camera(vertices, camera)[faces]
        directions = _directions(camera)
        length = directions.norm(dim=1)
        near, far = (length.new_zeros(len(length)), length.new_full((len(length),), torch.inf))
        if interval is not None:
            near, far = (limit.double().reshape(-1) for limit in interval)
        plane = max(NEAREST_PLANE, float((near / length).min()))
        depth = length.new_full((len(length),), torch.inf)
        face = torch.full((len(length),), -1, device=depth.device)
        for triangle, place in _candidates(corners, camera, plane):
            weights, z = _intersect(corners[triangle], directions[place])
            t = z * length[place]
            inside = (weights >= 0).all(dim=1) & (z > 0) & (t >= near[place]) & (t <= far[place])
            which, pixel, t = triangle[inside], place[inside], t[inside]
            nearest = torch.full_like(depth, torch.inf).scatter_reduce(0, pixel, t, "amin")
            first = t == nearest[pixel]
            winner = torch.full_like(face, len(faces)).scatter_reduce(0, pixel[first], which[first], "amin")
            closer = nearest < depth
            depth, face = torch.where(closer, nearest, depth), torch.where(closer, winner, face)
        barycentric = directions.new_zeros(len(length), 3)
        hit = face >= 0
        barycentric[hit] = _intersect(corners[face[hit]], directions[hit])[0]
    shape = camera.height, camera.width
    return Fragments(face.view(shape), barycentric.view(*shape, 3).to(vertices), depth.view(shape).to(vertices))


def mesh_interpolate(fragments: Fragments, faces: Int[Tensor, "f 3"], features: Float[Tensor, "v c"]) -> Float[Tensor, "h w c"]:
    """Weighted sums of the features at each fragment's corners."""
    hit = fragments.face >= 0
    corners = features[faces[fragments.face[hit]]]
    values = (fragments.barycentric[hit][..., None] * corners).sum(dim=1)
    image = values.new_zeros(*fragments.face.shape, features.shape[1])
    return image.index_put((hit,), values)


def hit(
    origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Intersection of rays with the planes of triangles, differentiable in all arguments.

    Args:
        origins: of the rays.
        directions: of the rays, unit vectors.
        corners: of one triangle for each ray.

    Returns:
        Barycentric coordinates, and distances along the rays.
    """
    return _intersect(corners - origins[:, None], directions)


def _in_camera(vertices: Float[Tensor, "v 3"], camera: Camera) -> Float[Tensor, "v 3"]:
    """Vertices in the camera's frame, double precision."""
    camera = camera.to(torch.float64)
    return (vertices.double() - camera.position) @ camera.cam_to_world[:3, :3]


def _directions(camera: Camera) -> Float[Tensor, "pixels 3"]:
    """Directions (x, y, 1) through the pixels' centres in the camera's frame, row by row."""
    camera = camera.to(torch.float64)
    plane = (camera.pixel_centres().reshape(-1, 2) - camera.principal_point) / camera.focal
    return torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1)


def _intersect(
    corners: Float[Tensor, "n 3 3"], directions: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Barycentric coordinates and ray parameter of rays from the origin: Σ b_i v_i = z d with Σ b_i = 1.

    With the edge functions e_i = d · (v_j × v_k) and the determinant D = det(v_0, v_1, v_2): b_i = e_i / Σ e, z = D / Σ e. All
    are NaN or infinite where the ray is parallel to the triangle's plane, and fail every comparison.
    """
    a, b, c = corners.unbind(dim=1)
    normals = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1)
    edges = (normals * directions[:, None]).sum(dim=2)
    total = edges.sum(dim=1)
    determinant = (a * normals[:, 0]).sum(dim=1)
    return edges / total[:, None], determinant / total


def _candidates(
    corners: Float[Tensor, "f 3 3"], camera: Camera, plane: float
) -> Iterator[tuple[Int[Tensor, " m"], Int[Tensor, " m"]]]:
    """Pairs of a triangle and a pixel of its bounding box, triangle by triangle, about `PAIRS` at once."""
    if not len(corners):
        return
    lo, hi = _boxes(corners, camera, plane)
    size = (hi - lo).clamp_min(0)
    count = size[:, 0] * size[:, 1]
    group = count.cumsum(0).div(PAIRS, rounding_mode="floor")
    for which in torch.split(torch.arange(len(count), device=count.device), torch.bincount(group).tolist()):
        face = which.repeat_interleave(count[which])
        start = count[which].cumsum(0) - count[which]
        place = torch.arange(len(face), device=face.device) - start.repeat_interleave(count[which])
        x, y = lo[face, 0] + place % size[face, 0], lo[face, 1] + place // size[face, 0]
        yield face, y * camera.width + x


def _boxes(corners: Float[Tensor, "f 3 3"], camera: Camera, plane: float) -> tuple[Int[Tensor, "f 2"], Int[Tensor, "f 2"]]:
    """First and last (exclusive) pixel along x and y whose centre may see each triangle beyond ``plane``; empty if none."""
    camera = camera.to(torch.float64)
    ahead = corners[..., 2] >= plane
    # Where an edge crosses the plane, its crossing is a corner of the part that is ahead.
    following = corners.roll(-1, dims=1)
    share = (plane - corners[..., 2]) / (following[..., 2] - corners[..., 2])
    crossing = corners + share[..., None] * (following - corners)
    crossing[..., 2] = plane
    points = torch.cat([corners, crossing], dim=1)
    counted = torch.cat([ahead, ahead != ahead.roll(-1, dims=1)], dim=1)[..., None]
    image = camera.principal_point + camera.focal * points[..., :2] / points[..., 2:]
    lowest = torch.where(counted, image, torch.inf).amin(dim=1)
    highest = torch.where(counted, image, -torch.inf).amax(dim=1)
    limit = torch.tensor([camera.width, camera.height], device=corners.device, dtype=corners.dtype)
    # One more pixel on each side than rounding could need; infinities and NaN become empty boxes.
    lo = (lowest - 0.5).floor().nan_to_num(nan=torch.inf).clamp(torch.zeros_like(limit), limit)
    hi = ((highest - 0.5).ceil() + 1).nan_to_num(nan=0.0).clamp(torch.zeros_like(limit), limit)
    return lo.long(), hi.long()
