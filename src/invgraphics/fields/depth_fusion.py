"""Fusion of depth maps to a mesh by truncated signed distances (TSDF)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.mesh import Mesh
from invgraphics.core.rendering import Rendering
from invgraphics.fields.isosurface import Extracted, VoxelGrid, compacted, marching_cubes, without_specks
from invgraphics.memory import check_fits

TRUNCATION = 4.0
"""Truncation distance of signed distances, in voxels."""
GRAZING = 0.05
"""Least weight of a picture that grazes a surface; one that faces it has 1."""
CHUNK = 1 << 20
"""Voxels that are evaluated together."""
VOXEL_BYTES = 24
"""Of a voxel's sums: of distances, weights, and colours with theirs."""


@torch.no_grad()
def fuse_depth(cameras: Sequence[Camera], render: Callable[[int], Rendering], bounds: Bounds, resolution: int) -> Extracted:
    """Fuse depth maps to a mesh with vertex colours by truncated signed distances (TSDF; Curless and Levoy 1996).

    Each picture gives every voxel in front of its surface, and up to `TRUNCATION` voxels behind it, a signed distance along the
    ray; the surface is where the mean over pictures is zero. Where pictures have normals, distances are weighted by the cosine
    between ray and normal. Voxels that no picture observed near its surface stay open.

    Args:
        cameras: of the pictures.
        render: the picture of a camera, by its index; infinite depth means that nothing is there.
        bounds: the box that is looked at.
        resolution: voxels along the longest edge.

    Raises:
        InputError: the pictures show no surface, or the voxels do not fit into memory.
    """
    grid = VoxelGrid.across(bounds, resolution)
    check_fits(VOXEL_BYTES * len(grid), f"Depth fusion with {len(grid):,} voxels", "Choose a lower resolution.")
    band = TRUNCATION * grid.step
    sums, counts, light = torch.zeros(len(grid)), torch.zeros(len(grid)), torch.zeros(len(grid), 4)
    for index, camera in enumerate(cameras):
        picture = render(index)
        worth = _view_cosines(picture, camera)
        for first in range(0, len(grid), CHUNK):
            part = slice(first, min(first + CHUNK, len(grid)))
            distance, pixel = _projective_distances(grid.centres(part.start, part.stop), camera, picture.depth)
            weight = torch.where(distance >= -band, worth[pixel], 0.0)
            sums[part] += weight * (distance / band).clamp(-1, 1)
            counts[part] += weight
            # Colour counts where the surface is near.
            close = torch.where(distance.abs() <= band, weight, 0.0)
            opaque = picture.rgb.reshape(-1, 3)[pixel] / picture.alpha.reshape(-1, 1)[pixel].clamp_min(1e-3)
            light[part] += close[:, None] * torch.nn.functional.pad(opaque, (0, 1), value=1.0)
    seen = (counts > 0).view(grid.shape)
    volume = torch.where(seen, -(sums / counts.clamp_min(GRAZING)).view(grid.shape), -1.0)
    vertices, faces = marching_cubes(volume, 0.0, "The surface in the depth pictures")
    faces = faces[_inside_known(vertices, faces, seen)]
    colours = (light[:, :3] / light[:, 3:].clamp_min(GRAZING)).view(*grid.shape, 3)
    nearest = tuple(vertices.round().long().unbind(dim=1))
    places = (grid.origin + grid.step * vertices.to(grid.origin)).cpu()
    return without_specks(compacted(Mesh.coloured(places, faces, colours[nearest])))


def _view_cosines(picture: Rendering, camera: Camera) -> Float[Tensor, " pixels"]:
    """Cosine between each pixel's ray and its surface's normal, at least `GRAZING`; 1 where there is no normal."""
    if picture.normal is None:
        return torch.ones(camera.width * camera.height)
    normal = picture.normal.reshape(-1, 3)
    cosine = -(normal * camera.rays().directions).sum(dim=1)
    return torch.where(normal.any(dim=1), cosine.clamp(GRAZING, 1), 1.0)


def _projective_distances(
    points: Float[Tensor, "n 3"], camera: Camera, depth: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Projective signed distance of each point before its pixel's depth, -inf outside the picture; and that pixel's index."""
    inside, pixel = camera.pixel_of(points)
    distance = depth.reshape(-1)[pixel] - (points - camera.position).norm(dim=1)
    return torch.where(inside, distance, -torch.inf), pixel


def _inside_known(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], seen: Bool[Tensor, "x y z"]) -> Bool[Tensor, " f"]:
    """Mask of faces inside voxel cubes all of whose corners were observed."""
    corners = [seen[i : seen.shape[0] - 1 + i, j : seen.shape[1] - 1 + j, k : seen.shape[2] - 1 + k]
               for i in (0, 1) for j in (0, 1) for k in (0, 1)]  # fmt: skip
    known = torch.stack(corners).all(dim=0)
    cube = vertices[faces].mean(dim=1).floor().long()
    limit = torch.tensor(known.shape) - 1
    return known[tuple(torch.minimum(cube, limit).unbind(dim=1))]
