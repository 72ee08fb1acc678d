"""Triangle meshes with a normal and a texture coordinate per vertex, and the shapes that the scenes are put together from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

Point = Sequence[float] | np.ndarray


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; corners that do not share a normal or texture coordinate are vertices of their own."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]

    def moved(self, offset: Point) -> Mesh:
        """Translated."""
        return replace(self, vertices=self.vertices + np.asarray(offset, dtype=float))

    def scaled(self, factor: float) -> Mesh:
        """Scaled about the origin, the same along all axes."""
        return replace(self, vertices=self.vertices * factor)

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> Mesh:
        """Rotated about the origin."""
        return replace(self, vertices=self.vertices @ rotation.T, normals=self.normals @ rotation.T)


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of many."""
    meshes = list(meshes)
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
    )


def rotation(axis: str, degrees: float) -> Float[np.ndarray, "3 3"]:
    """Right-handed rotation about a coordinate axis."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix[first, first], matrix[first, second], matrix[second, first], matrix[second, second] = c, -s, s, c
    return matrix


def solid(points: Float[np.ndarray, "p 3"], polygons: Iterable[Sequence[int]]) -> Mesh:
    """A convex solid with flat faces; polygons may wind either way."""
    return merge(polygon(points[list(corners)], away_from=points.mean(axis=0)) for corners in polygons)


def polygon(corners: Float[np.ndarray, "n 3"], away_from: Point | None = None) -> Mesh:
    """A flat convex polygon, counter-clockwise seen from its front, or turned so that its front looks ``away_from`` a point.

    Texture coordinates run over the unit square in the order of the corners of a quadrilateral.
    """
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal = normal / np.linalg.norm(normal)
    if away_from is not None and normal @ (corners.mean(axis=0) - np.asarray(away_from)) < 0:
        corners, normal = corners[::-1], -normal
    count = len(corners)
    faces = np.array([(0, i, i + 1) for i in range(1, count - 1)])
    uv = np.resize(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (count, 2))
    return Mesh(corners.astype(float), faces, np.tile(normal, (count, 1)), uv)


def box(lo: Point, hi: Point, chamfer: float = 0.0) -> Mesh:
    """An axis-aligned box, its edges cut at 45 degrees by ``chamfer`` so that they catch the light."""
    lo, hi = np.asarray(lo, dtype=float), np.asarray(hi, dtype=float)
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    cube = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    if chamfer == 0:
        return solid(lo + corners * (hi - lo), cube)
    # Point 3 c + a is corner c pulled inwards along the two axes other than a: it lies in the face normal to a.
    signs = 2 * corners - 1
    pulled = lo + corners * (hi - lo)
    points = np.concatenate([[pulled[c] - signs[c] * chamfer * (np.arange(3) != a) for a in range(3)] for c in range(8)])
    sides = [[3 * c + a for c in face] for face, a in zip(cube, (0, 0, 1, 1, 2, 2), strict=True)]
    cut_corners = [[3 * c, 3 * c + 1, 3 * c + 2] for c in range(8)]
    edges = []
    for first in range(8):
        for axis in range(3):
            second = first | (4 >> axis)
            if second != first:
                a, b = (other for other in range(3) if other != axis)
                edges.append([3 * first + a, 3 * second + a, 3 * second + b, 3 * first + b])
    return solid(points, sides + edges + cut_corners)


def lathe(profile: Sequence[tuple[float, float]], sides: int = 32) -> Mesh:
    """A surface of revolution about +z, round in one direction and with the profile's corners kept.

    Texture coordinates follow the angle and the length along the profile.

    Args:
        profile: (radius, height), from the lower axis around the outside to the upper axis.
        sides: corners of the circle.
    """
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    bands = []
    lengths = np.hypot(*np.diff(np.array(profile), axis=0).T)
    ends = np.concatenate([[0], np.cumsum(lengths)]) / lengths.sum()
    for (r0, z0), (r1, z1), heights in zip(profile, profile[1:], pairwise(ends), strict=False):
        slope = np.array([z1 - z0, r0 - r1]) / np.hypot(z1 - z0, r1 - r0)  # outward normal of the profile: (radial, up)
        rows = [np.column_stack([r * ring, np.full(sides + 1, z)]) for r, z in ((r0, z0), (r1, z1))]
        normals = np.column_stack([slope[0] * ring, np.full(sides + 1, slope[1])])
        uv = [np.column_stack([angle / (2 * np.pi), np.full(sides + 1, v)]) for v in heights]
        quads = _quads(2, sides + 1)
        keep = np.concatenate([np.full(sides, r0 > 0), np.full(sides, r1 > 0)])
        bands.append(Mesh(np.concatenate(rows), quads[keep], np.tile(normals, (2, 1)), np.concatenate(uv)))
    return merge(bands)


def cylinder(radius: float, height: float, sides: int = 32, bevel: float = 0.0) -> Mesh:
    """An upright cylinder that stands on the origin, with a bevelled upper rim."""
    rim = [(radius, height - bevel), (radius - bevel, height)] if bevel else [(radius, height)]
    return lathe([(0, 0), (radius, 0), *rim, (0, height)], sides)


def tube(path: Float[np.ndarray, "n 3"], radius: float | np.ndarray, sides: int = 10) -> Mesh:
    """A round tube along a smooth path, open at its ends; ``radius`` may change along it."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()])
    around = np.linspace(0, 2 * np.pi, sides + 1)
    normals = []
    for direction in tangent:  # parallel transport: the frame turns no more than the path does
        side = side - direction * (side @ direction)
        side /= np.linalg.norm(side)
        normals.append(np.outer(np.cos(around), side) + np.outer(np.sin(around), np.cross(direction, side)))
    normals = np.stack(normals)
    return sheet(path[:, None] + np.reshape(radius, (-1, 1, 1)) * normals, normals)


def sheet(points: Float[np.ndarray, "a b 3"], normals: Float[np.ndarray, "a b 3"] | None = None) -> Mesh:
    """A smooth surface over a grid of points; its front is towards (d points / d b) x (d points / d a)."""
    rows, columns = points.shape[:2]
    if normals is None:
        crossed = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        normals = np.asarray(crossed / np.linalg.norm(crossed, axis=-1, keepdims=True))
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    return Mesh(points.reshape(-1, 3), _quads(rows, columns), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2))


def sphere(centre: Point, radius: float, rows: int = 48) -> Mesh:
    """A sphere from rings of latitude."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    profile = [(max(0.0, float(np.cos(a))), float(np.sin(a))) for a in angle]
    profile[0], profile[-1] = (0.0, -1.0), (0.0, 1.0)
    unit = lathe(profile, 2 * rows)
    return replace(unit, normals=unit.vertices).scaled(radius).moved(centre)


def _quads(rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    """Two triangles per cell of a grid of vertices: all the first halves (on the lower row), then all the second."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper])
