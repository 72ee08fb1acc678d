"""Distances between surfaces: accuracy, completeness, Chamfer distance, F-score and normal consistency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics import kernels
from invgraphics.core import Camera, Mesh
from invgraphics.core.mesh import face_normals

POINTS = 100_000
"""Points on either surface that are compared."""
F_SCORE_SHARE = 0.01
"""Threshold of the F-score, over the longest edge of the data set's box (Tatarchenko et al. 2019, §5.1)."""
CANDIDATES = 8
"""Nearest samples of a surface whose triangles a distance to it is computed from."""
VIEW_PIXELS = 256
"""Least size, along the longer side, of the depth maps that decide which points a camera sees."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points on a mesh.

    Attributes:
        position: of the points.
        normal: unit normals of their triangles.
        face: their triangles.
    """

    position: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    face: Int[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, index: Tensor) -> SurfaceSamples:
        return SurfaceSamples(self.position[index], self.normal[index], self.face[index])


@dataclass(frozen=True)
class SurfaceDistance:
    """Comparison of two surfaces, in their units.

    Attributes:
        accuracy: mean distance of predicted points to the true surface.
        completeness: mean distance of true points to the predicted surface.
        precision: share of predicted points within the threshold.
        recall: share of true points within it.
        normal_consistency: mean |cosine| between normals of points and of the nearest points of the other surface, both ways.
    """

    accuracy: float
    completeness: float
    precision: float
    recall: float
    normal_consistency: float

    @property
    def chamfer(self) -> float:
        """Chamfer distance: mean of accuracy and completeness (not squared)."""
        return (self.accuracy + self.completeness) / 2

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall (Knapitsch et al. 2017)."""
        return 2 * self.precision * self.recall / max(self.precision + self.recall, 1e-12)


def compare_surfaces(
    predicted: Mesh, true: Mesh, threshold: float, cameras: Sequence[Camera] = (), count: int = POINTS, seed: int = 0
) -> SurfaceDistance:
    """Compare two meshes by random points on each and their distances to the other.

    Args:
        predicted: of a fit.
        true: the truth.
        threshold: of precision and recall, a distance.
        cameras: points count if one of these sees them, each surface as far as it hides itself; without cameras all count.
        count: points on either surface, before those that no camera sees are left out.
        seed: of the points.

    Raises:
        ValueError: no camera sees any point of one of them.
    """
    generator = torch.Generator().manual_seed(seed)
    ours, theirs = sample_surface(predicted, count, generator), sample_surface(true, count, generator)
    if cameras:
        ours, theirs = (
            samples[visible(mesh, samples.position, cameras)] for mesh, samples in ((predicted, ours), (true, theirs))
        )
    if not len(ours) or not len(theirs):
        raise ValueError("no camera sees the " + ("predicted" if not len(ours) else "true") + " surface")
    to_true, at_true = nearest_on(true, ours.position, count)
    to_ours, at_ours = nearest_on(predicted, theirs.position, count)
    normals = [
        float((samples.normal * nearest).sum(dim=1).abs().mean()) for samples, nearest in ((ours, at_true), (theirs, at_ours))
    ]
    return SurfaceDistance(
        float(to_true.mean()),
        float(to_ours.mean()),
        float((to_true <= threshold).double().mean()),
        float((to_ours <= threshold).double().mean()),
        sum(normals) / 2,
    )


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> SurfaceSamples:
    """Uniform random points on a mesh, double precision.

    Args:
        mesh: triangles are drawn by area.
        count: points wanted.
        generator: source of randomness.

    Raises:
        ValueError: the mesh has no area.
    """
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(dim=1)
    normals = torch.linalg.cross(b - a, c - a)
    # torch.multinomial takes at most 2^24 classes.
    cumulative = normals.norm(dim=1).cumsum(0)
    if not len(cumulative) or not float(cumulative[-1]) > 0:
        raise ValueError("the mesh has no area")
    chosen = torch.searchsorted(cumulative, torch.rand(count, generator=generator, dtype=torch.float64) * cumulative[-1])
    chosen = chosen.clamp_max(len(mesh.faces) - 1)
    u, v = torch.rand(2, count, 1, generator=generator, dtype=torch.float64)
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    return SurfaceSamples(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen], normalize(normals[chosen], dim=1), chosen)


@torch.no_grad()
def visible(mesh: Mesh, points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Bool[Tensor, " n"]:
    """Which points of a mesh at least one camera sees: inside its picture and no farther than the mesh's depth map there.

    The depth is the largest of the four pixel centres around a point's image, so that no slope hides the surface from itself.
    So some hidden surface counts where it is within a pixel of a silhouette in the picture: on `bricks` 0.425 of all points
    count with depth maps of 256 pixels, 0.392 with 1024. A surface that lacks what is hidden has a completeness of up to 0.0006
    there, however exact.

    Args:
        mesh: what hides the points.
        points: on it.
        cameras: at `VIEW_PIXELS` at least.
    """
    seen = torch.zeros(len(points), dtype=torch.bool)
    vertices = mesh.vertices.float()
    for own in cameras:
        scale = max(1.0, VIEW_PIXELS / max(own.width, own.height))
        camera = own.resized(round(scale * own.width), round(scale * own.height)).to(torch.float32)
        hidden = (~seen).nonzero()[:, 0]
        place, z = camera.project(points[hidden].float())
        size = torch.tensor([camera.width, camera.height])
        inside = (z > 0) & (place >= 0).all(dim=1) & (place <= size).all(dim=1)
        hidden, place = hidden[inside], place[inside]
        depth = kernels.mesh_rasterise(vertices, mesh.faces, camera).depth
        first = (place - 0.5).floor().long()
        columns, rows = ([(first[:, axis] + step).clamp(0, int(size[axis]) - 1) for step in (0, 1)] for axis in (0, 1))
        farthest = torch.stack([depth[row, column] for row in rows for column in columns]).amax(dim=0)
        distance = (points[hidden].float() - camera.position).norm(dim=1)
        seen[hidden[distance <= farthest + 0.1 * distance / camera.focal.mean()]] = True
    return seen


def nearest_on(
    mesh: Mesh, points: Float[Tensor, "n 3"], count: int = POINTS
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Distances of points to a mesh, and the unit normals of its nearest triangles, double precision.

    Candidates are the triangles of the `CANDIDATES` nearest among the middles of all triangles and as many random samples;
    distances to them are exact.

    Args:
        mesh: triangles.
        points: anywhere.
        count: random samples of the mesh, at least one for each triangle.
    """
    from scipy.spatial import KDTree

    samples = sample_surface(mesh, max(count, len(mesh.faces)), torch.Generator().manual_seed(0))
    corners = mesh.vertices.double()[mesh.faces]
    known = torch.cat([corners.mean(dim=1), samples.position])
    owner = torch.cat([torch.arange(len(mesh.faces)), samples.face])
    _, near = KDTree(known.numpy()).query(points.double().numpy(), k=min(CANDIDATES, len(known)))
    faces = owner[torch.from_numpy(near).view(len(points), -1)]
    repeated = points.double().repeat_interleave(faces.shape[1], dim=0)
    distance, best = triangle_distance(repeated, corners[faces.reshape(-1)]).view(faces.shape).min(dim=1)
    chosen = faces.gather(1, best[:, None])[:, 0]
    return distance, normalize(face_normals(mesh.vertices.double(), mesh.faces[chosen]), dim=1)


def triangle_distance(points: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Distance of each point to its triangle: to the plane where it projects inside, else to the nearest edge."""
    ends = corners.roll(-1, dims=1)
    edges, offset = ends - corners, points[:, None] - corners
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
    # Inside, the point is on the left of every edge.
    side = (torch.linalg.cross(edges, offset) * normal[:, None]).sum(dim=2)
    share = ((offset * edges).sum(dim=2) / edges.square().sum(dim=2).clamp_min(1e-300)).clamp(0, 1)
    to_edge = (offset - share[..., None] * edges).norm(dim=2).amin(dim=1)
    length = normal.norm(dim=1)
    to_plane = (offset[:, 0] * normal).sum(dim=1).abs() / length.clamp_min(1e-300)
    return torch.where((side >= 0).all(dim=1) & (length > 0), to_plane, to_edge)
