"""Isosurface extraction: marching cubes on a field's signed distance or density, over a regular grid of voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Field, Quantity
from invgraphics.core.mesh import Mesh, vertex_normals
from invgraphics.core.samples import Samples
from invgraphics.errors import InputError

HALF_OPAQUE = 0.01
"""The default level of a density is that of which this share of the bounds' diagonal has alpha 1/2."""
SPECK = 1e-3
"""Pieces of a surface with a smaller share of its triangles are left out: fog and floaters."""
BLOCK = 4
"""Edge, in voxels, of the blocks of a signed distance that are evaluated only near the surface."""
LIPSCHITZ = 2.0
"""Bound on the gradient of a fitted distance: blocks with centres farther away than this times their radius are uniform."""
CHUNK = 1 << 16
"""Points at which the field is queried at once."""
REMEDY = "Fit it for longer."
"""What to do about a volume without the level; callers with a level of their own to choose say so."""


@dataclass(frozen=True, eq=False)
class VoxelGrid:
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
    def across(bounds: Bounds, resolution: int) -> VoxelGrid:
        """Make the grid of voxels that fills the bounds' box, ``resolution`` along its longest edge."""
        edges = bounds.hi - bounds.lo
        step = float(edges.max()) / resolution
        counts = tuple(max(1, math.ceil(edge / step - 1e-4)) for edge in edges.tolist())
        return VoxelGrid(bounds.lo + step / 2, step, (counts[0], counts[1], counts[2]))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def centres(self, first: int, last: int) -> Float[Tensor, "n 3"]:
        """Positions of the voxel centres ``first`` to ``last`` (exclusive), z fastest."""
        return self.at(torch.arange(first, min(last, len(self)), device=self.origin.device))

    def at(self, flat: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Positions of voxel centres by their flat indices."""
        return self.origin + self.step * torch.stack(torch.unravel_index(flat, self.shape), dim=1)


@dataclass(frozen=True, eq=False)
class Extracted:
    """An extracted mesh, and how many small pieces were left out."""

    mesh: Mesh
    dropped: int = 0


def default_level(bounds: Bounds) -> float:
    """Default isosurface density per local unit: a share `HALF_OPAQUE` of the bounds' diagonal at it has alpha 1/2."""
    return math.log(2) / (HALF_OPAQUE * 2 * bounds.radius)


@torch.no_grad()
def extract_mesh(field: Field, bounds: Bounds, resolution: int, level: float | None = None, remedy: str = REMEDY) -> Extracted:
    """Extract an isosurface of a field's signed distance, or else of its density, closed at the box.

    Vertices have normals, and, where the field has radiance, the colour that is seen from outside along the normal.

    Args:
        field: provides a signed distance or a density; in a contracted space the box of its bounds is taken.
        bounds: what is looked at.
        resolution: voxels along the longest edge.
        level: density per local unit (``None``: `default_level`), or signed distance (``None``: 0).
        remedy: what the user can do where the level is nowhere.

    Raises:
        InputError: the field has neither density nor signed distance, or nowhere the level.
    """
    distances = Quantity.SDF in field.provides
    if not distances and Quantity.DENSITY not in field.provides:
        raise InputError(f"{type(field).__name__} provides {field.provides.words()}, neither density nor signed distance.")
    grid = VoxelGrid.across(bounds, resolution)
    # Both grow towards the inside, so that one rule separates front from back.
    if distances:
        level = 0.0 if level is None else level
        volume, level, what = -_signed_distances(field, grid, level), -level, "The signed distance"
        outside = float(volume.min()) - grid.step
    else:
        level = default_level(bounds) if level is None else level
        volume, what, outside = _densities(field, grid), "The density", 0.0
    volume = torch.nn.functional.pad(volume, (1,) * 6, value=outside)
    vertices, faces = marching_cubes(volume, level, what, remedy, negated=distances)
    extracted = without_specks(Mesh(grid.origin + grid.step * (vertices.to(grid.origin) - 1), faces.to(grid.origin.device)))
    return replace(extracted, mesh=with_attributes(extracted.mesh, field))


def with_attributes(mesh: Mesh, field: Field) -> Mesh:
    """Give a mesh of a field normals, and the field's radiance along them from outside, where it provides radiance."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    mesh = replace(mesh, normals=normals)
    if Quantity.RADIANCE not in field.provides:
        return mesh
    parts = [torch.zeros_like(mesh.vertices[:0])]
    for place, normal in zip(mesh.vertices.split(CHUNK), normals.split(CHUNK), strict=True):
        radiance = field.query(Samples.at(place, -normal), Quantity.RADIANCE).radiance
        assert radiance is not None
        parts.append(radiance)
    return replace(mesh, sh=Mesh.coloured(mesh.vertices, mesh.faces, torch.cat(parts)).sh)


def _densities(field: Field, grid: VoxelGrid) -> Float[Tensor, "x y z"]:
    """Density at all voxel centres."""
    parts = [field.density_no_grad(Samples.at(grid.centres(first, first + CHUNK))) for first in range(0, len(grid), CHUNK)]
    return torch.cat(parts).view(grid.shape)


def _signed_distances(field: Field, grid: VoxelGrid, level: float) -> Float[Tensor, "x y z"]:
    """Signed distance at the voxel centres; in blocks that the level cannot cross, that of the block's centre."""
    counts = [math.ceil(count / BLOCK) for count in grid.shape]
    middle = grid.origin + grid.step * (BLOCK - 1) / 2
    blocks = VoxelGrid(middle, BLOCK * grid.step, (counts[0], counts[1], counts[2]))
    coarse = _sdf(field, blocks, torch.arange(len(blocks), device=grid.origin.device)).view(blocks.shape)
    for axis in range(3):
        coarse = coarse.repeat_interleave(BLOCK, dim=axis)
    volume = coarse[: grid.shape[0], : grid.shape[1], : grid.shape[2]].contiguous()
    radius = 3**0.5 / 2 * (BLOCK - 1) * grid.step
    near = ((volume - level).abs() <= LIPSCHITZ * radius).view(-1).nonzero()[:, 0]
    volume.view(-1)[near] = _sdf(field, grid, near)
    return volume


def _sdf(field: Field, grid: VoxelGrid, flat: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    parts = [torch.zeros_like(grid.origin[:0])]
    for part in flat.split(CHUNK):
        distance = field.query_no_grad(Samples.at(grid.at(part)), Quantity.SDF).sdf
        assert distance is not None
        parts.append(distance)
    return torch.cat(parts)


def marching_cubes(
    volume: Float[Tensor, "x y z"], level: float, what: str, remedy: str = REMEDY, *, negated: bool = False
) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    """Marching cubes (Lewiner et al. 2003): isosurface around values above the level.

    Args:
        volume: values at voxel centres.
        level: of the surface.
        what: the volume's name, for the sentence of an error.
        remedy: what the user can do, for its second line.
        negated: whether values and level are the negatives of what ``what`` names, as the sentence gives them.

    Returns:
        Vertices, in voxels, and outward faces.

    Raises:
        InputError: there is none.
    """
    from skimage.measure import marching_cubes as march

    values = volume.cpu().numpy().astype(np.float32)
    if min(values.shape) < 2 or not values.min() < level < values.max():
        sign = -1 if negated else 1
        least, most = sorted((sign * float(values.min()), sign * float(values.max())))
        # Adding zero makes a zero of -0.
        raise InputError(f"{what} has no level {sign * level + 0:.4g}: it runs from {least + 0:.4g} to {most + 0:.4g}.", remedy)
    # "ascent" turns its triangles outwards for objects that are higher than what is around them.
    vertices, faces, *_ = march(values, level, gradient_direction="ascent", allow_degenerate=False)
    return torch.from_numpy(vertices.copy()), torch.from_numpy(faces.astype(np.int64))


def without_specks(mesh: Mesh) -> Extracted:
    """Remove the smallest connected components of a mesh; of its largest, at least one stays."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, n = mesh.faces.cpu().numpy(), len(mesh.vertices)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    pieces, label = connected_components(graph, directed=False)
    sizes = np.bincount(label[faces[:, 0]], minlength=pieces)
    kept = sizes >= min(SPECK * len(faces), sizes.max())
    chosen = torch.from_numpy(faces[kept[label[faces[:, 0]]]]).to(mesh.faces.device)
    return Extracted(compacted(replace(mesh, faces=chosen)), int(((sizes > 0) & ~kept).sum()))


def compacted(mesh: Mesh) -> Mesh:
    """The mesh without vertices that no face has."""
    used, corners = mesh.faces.unique(return_inverse=True)
    attributes = {name: getattr(mesh, name) for name in ("vertices", "normals", "sh")}
    kept = {name: None if value is None else value[used] for name, value in attributes.items()}
    return replace(mesh, faces=corners.view(-1, 3), **kept)
