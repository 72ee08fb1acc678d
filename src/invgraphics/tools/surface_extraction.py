"""Surface extraction: marching cubes on a density or signed distance, and TSDF fusion of depth maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core import Bounds, Camera, Field, Quantity, Rendering, Samples
from invgraphics.errors import InputError
from invgraphics.renderers.volumetric import query

HALF_OPAQUE = 0.01
"""The default level of a density is that of which this share of the bounds' diagonal has alpha 1/2."""
TRUNCATION = 4.0
"""Truncation distance of signed distances, in voxels."""
GRAZING = 0.05
"""Least weight of a picture that grazes a surface; one that faces it has 1."""
SPECK = 1e-3
"""Pieces of a surface with a smaller share of its triangles are left out: fog and floaters."""
CHUNK = 1 << 20
"""Voxels that are evaluated together."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A coloured triangle mesh, local frame.

    Attributes:
        vertices: places.
        faces: corners, anticlockwise seen from outside.
        rgb: colours in the scene's colour space.
        dropped: small pieces that were left out.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    rgb: Float[Tensor, "v 3"]
    dropped: int = 0

    @property
    def open_edges(self) -> int:
        """Number of boundary edges, which belong to one triangle only; 0 for a closed surface."""
        edges = torch.cat([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).sort(dim=1).values
        _, counts = edges.unique(dim=0, return_counts=True)
        return int((counts == 1).sum())


@dataclass(frozen=True, eq=False)
class Lattice:
    """Voxel centres: a regular grid whose cells are cubes.

    Attributes:
        origin: the first centre.
        step: distance between neighbours, local units.
        shape: number of voxels along x, y and z.
    """

    origin: Float[Tensor, 3]
    step: float
    shape: tuple[int, int, int]

    @staticmethod
    def across(bounds: Bounds, resolution: int) -> Lattice:
        """Make the lattice of voxels that fills the bounds' box, ``resolution`` along its longest edge."""
        edges = bounds.hi - bounds.lo
        step = float(edges.max()) / resolution
        counts = tuple(max(1, math.ceil(edge / step - 1e-4)) for edge in edges.tolist())
        return Lattice(bounds.lo + step / 2, step, (counts[0], counts[1], counts[2]))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def centres(self, first: int, last: int) -> Float[Tensor, "n 3"]:
        """Positions of the voxel centres ``first`` to ``last`` (exclusive), z fastest."""
        flat = torch.arange(first, min(last, len(self)), device=self.origin.device)
        index = torch.stack(torch.unravel_index(flat, self.shape), dim=1)
        return self.origin + self.step * index


def default_level(bounds: Bounds) -> float:
    """Default isosurface density per local unit: a share `HALF_OPAQUE` of the bounds' diagonal at it has alpha 1/2."""
    return math.log(2) / (HALF_OPAQUE * 2 * bounds.radius)


@torch.no_grad()
def field_surface(field: Field, bounds: Bounds, resolution: int, level: float | None = None, chunk: int = 1 << 16) -> Surface:
    """Extract an isosurface of a field's signed distance, or else of its density, closed at the box.

    Args:
        field: provides density and radiance; in a contracted space the box of its bounds is taken.
        bounds: what is looked at.
        resolution: voxels along the longest edge.
        level: density per local unit (``None``: `default_level`), or signed distance (``None``: 0).
        chunk: samples handed to the field at once.

    Raises:
        InputError: the field has neither density nor signed distance, or nowhere the level.
    """
    wanted = Quantity.SDF if Quantity.SDF in field.provides else Quantity.DENSITY
    if not {wanted, Quantity.RADIANCE} <= set(field.provides):
        raise InputError(f"{type(field).__name__} provides {field.provides.words()}, not density and radiance.")
    lattice = Lattice.across(bounds, resolution)
    name, outside = ("sdf", math.inf) if wanted is Quantity.SDF else ("density", 0.0)
    level = level if level is not None else 0.0 if wanted is Quantity.SDF else default_level(bounds)
    parts = [
        getattr(query(field, Samples.at(lattice.centres(first, first + CHUNK)), wanted, chunk), name)
        for first in range(0, len(lattice), CHUNK)
    ]
    volume = torch.cat(parts).view(lattice.shape)
    outside = min(outside, float(volume.max()) + lattice.step)
    volume = torch.nn.functional.pad(volume, (1,) * 6, value=outside)
    # Both grow towards the inside, so that one rule tells front from back.
    sign = -1.0 if wanted is Quantity.SDF else 1.0
    vertices, faces = _march(sign * volume, sign * level, f"The {name.replace('sdf', 'signed distance')}")
    places = lattice.origin + lattice.step * (vertices.to(lattice.origin) - 1)
    seen = query(field, Samples.at(places, -outwards(vertices, faces).to(places)), Quantity.RADIANCE, chunk).radiance
    assert seen is not None
    return without_specks(Surface(places.cpu(), faces, seen.cpu()))


@torch.no_grad()
def fused_surface(cameras: Sequence[Camera], render: Callable[[int], Rendering], bounds: Bounds, resolution: int) -> Surface:
    """Fuse depth maps to a surface by truncated signed distances (TSDF; Curless and Levoy 1996).

    Each picture gives every voxel in front of its surface, and up to `TRUNCATION` voxels behind it, a signed distance along the
    ray; the surface is where the mean over pictures is zero. Where pictures have normals, distances are weighted by the cosine
    between ray and normal. Voxels that no picture observed near its surface stay open.

    Args:
        cameras: of the pictures.
        render: the picture of a camera, by its index; infinite depth means that nothing is there.
        bounds: the box that is looked at.
        resolution: voxels along the longest edge.

    Raises:
        InputError: the pictures show no surface.
    """
    lattice = Lattice.across(bounds, resolution)
    band = TRUNCATION * lattice.step
    sums, counts, light = torch.zeros(len(lattice)), torch.zeros(len(lattice)), torch.zeros(len(lattice), 4)
    for index, camera in enumerate(cameras):
        picture = render(index)
        worth = _view_cosines(picture, camera)
        for first in range(0, len(lattice), CHUNK):
            part = slice(first, min(first + CHUNK, len(lattice)))
            distance, pixel = _projective_distances(lattice.centres(part.start, part.stop), camera, picture.depth)
            weight = torch.where(distance >= -band, worth[pixel], 0.0)
            sums[part] += weight * (distance / band).clamp(-1, 1)
            counts[part] += weight
            # Colour counts where the surface is near.
            close = torch.where(distance.abs() <= band, weight, 0.0)
            opaque = picture.rgb.reshape(-1, 3)[pixel] / picture.alpha.reshape(-1, 1)[pixel].clamp_min(1e-3)
            light[part] += close[:, None] * torch.nn.functional.pad(opaque, (0, 1), value=1.0)
    seen = (counts > 0).view(lattice.shape)
    volume = torch.where(seen, -(sums / counts.clamp_min(GRAZING)).view(lattice.shape), -1.0)
    vertices, faces = _march(volume, 0.0, "The surface in the depth pictures")
    faces = faces[_inside_known(vertices, faces, seen)]
    colours = (light[:, :3] / light[:, 3:].clamp_min(GRAZING)).view(*lattice.shape, 3)
    nearest = tuple(vertices.round().long().unbind(dim=1))
    used, corners = faces.unique(return_inverse=True)
    places = (lattice.origin + lattice.step * vertices.to(lattice.origin)).cpu()
    return without_specks(Surface(places[used], corners.view(-1, 3), colours[nearest][used]))


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
    place, z = camera.project(points)
    column, row = place.floor().long().unbind(dim=1)
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = torch.where(inside, row * camera.width + column, 0)
    distance = depth.reshape(-1)[pixel] - (points - camera.position).norm(dim=1)
    return torch.where(inside, distance, -torch.inf), pixel


def _march(volume: Float[Tensor, "x y z"], level: float, what: str) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    """Marching cubes: vertices, in voxels, and outward faces of the isosurface around values above the level.

    Raises:
        InputError: there is none.
    """
    from skimage.measure import marching_cubes

    values = volume.cpu().numpy().astype(np.float32)
    if min(values.shape) < 2 or not values.min() < level < values.max():
        raise InputError(
            f"{what} has no level {abs(level):.4g}: it runs from {abs(values).min():.4g} to {abs(values).max():.4g}.",
            "Choose another --level, or fit for longer.",
        )
    # "ascent" turns its triangles outwards for objects that are higher than what is around them.
    vertices, faces, *_ = marching_cubes(values, level, gradient_direction="ascent", allow_degenerate=False)
    return torch.from_numpy(vertices.copy()), torch.from_numpy(faces.astype(np.int64))


def outwards(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Unit normals of the vertices: their triangles', weighted by area."""
    a, b, c = vertices[faces].unbind(dim=1)
    normals = torch.linalg.cross(b - a, c - a).repeat_interleave(3, dim=0)
    return torch.nn.functional.normalize(torch.zeros_like(vertices).index_add(0, faces.flatten(), normals), dim=1)


def _inside_known(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], seen: Bool[Tensor, "x y z"]) -> Bool[Tensor, " f"]:
    """Mask of faces inside voxel cubes all of whose corners were observed."""
    corners = [seen[i : seen.shape[0] - 1 + i, j : seen.shape[1] - 1 + j, k : seen.shape[2] - 1 + k]
               for i in (0, 1) for j in (0, 1) for k in (0, 1)]  # fmt: skip
    known = torch.stack(corners).all(dim=0)
    cube = vertices[faces].mean(dim=1).floor().long()
    limit = torch.tensor(known.shape) - 1
    return known[tuple(torch.minimum(cube, limit).unbind(dim=1))]


def without_specks(surface: Surface) -> Surface:
    """Remove the smallest connected components of a surface."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, n = surface.faces.numpy(), len(surface.vertices)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    pieces, label = connected_components(graph, directed=False)
    sizes = np.bincount(label[faces[:, 0]], minlength=pieces)
    kept = sizes >= SPECK * len(faces)
    chosen = torch.from_numpy(faces[kept[label[faces[:, 0]]]])
    used, corners = chosen.unique(return_inverse=True)
    dropped = int(((sizes > 0) & ~kept).sum())
    return Surface(surface.vertices[used], corners.view(-1, 3), surface.rgb[used], dropped)
