"""Triangle meshes with normals and view-dependent colours at their vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import harmonics


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; seen from outside, the corners of a face run anticlockwise.

    Attributes:
        vertices: positions, local frame.
        faces: indices of the three corners of each triangle.
        normals: unit normals of the vertices, pointing out of the surface; ``None`` where there are none.
        sh: real spherical-harmonics coefficients of each vertex's colour minus 0.5, k = (degree + 1)^2 of them, as of
            `Gaussians`; ``None`` where there is no colour. Colours between vertices are interpolated linearly.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    normals: Float[Tensor, "v 3"] | None = None
    sh: Float[Tensor, "v k 3"] | None = None

    @staticmethod
    def coloured(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], rgb: Float[Tensor, "v 3"]) -> Mesh:
        """Mesh whose vertex colours, in the scene's colour space, are the same in every direction."""
        return Mesh(vertices, faces, sh=harmonics.constant(rgb))

    @property
    def rgb(self) -> Float[Tensor, "v 3"] | None:
        """Mean of each vertex's colour over all directions, clamped at 0; ``None`` where there is no colour."""
        return None if self.sh is None else (self.sh[:, 0] * harmonics.BAND_0 + 0.5).clamp_min(0.0)

    def outwards(self) -> Float[Tensor, "v 3"]:
        """``normals``, else unit normals from the faces around each vertex, weighted by area; zero where there are none."""
        return vertex_normals(self.vertices, self.faces) if self.normals is None else self.normals

    def open_edges(self) -> int:
        """Number of boundary edges, which belong to one triangle only; 0 for a closed surface."""
        edges = torch.cat([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).sort(dim=1).values
        _, counts = edges.unique(dim=0, return_counts=True)
        return int((counts == 1).sum())

    def transformed(self, similarity: Float[Tensor, "4 4"]) -> Mesh:
        """The mesh under ``x -> s R x + c``, its normals and view-dependent colours turned along."""
        matrix = similarity.to(self.vertices)
        linear = matrix[:3, :3]
        rotation = linear / torch.linalg.det(linear.double()).abs().pow(1 / 3).to(linear)
        return replace(
            self,
            vertices=self.vertices @ linear.T + matrix[:3, 3],
            normals=None if self.normals is None else self.normals @ rotation.T,
            sh=None if self.sh is None else harmonics.rotate(self.sh, rotation),
        )

    def to(self, device: torch.device | str) -> Mesh:
        """Detach all tensors and move them to a device."""
        tensors = {name: value.detach().to(device) for name, value in vars(self).items() if value is not None}
        return Mesh(**tensors)


def face_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
    """Normals of triangles, of twice their areas' length, pointing to where their corners run anticlockwise."""
    a, b, c = vertices[faces].unbind(dim=1)
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Unit normals of vertices: those of the triangles around them, weighted by area."""
    normals = face_normals(vertices, faces).repeat_interleave(3, dim=0)
    return normalize(torch.zeros_like(vertices).index_add(0, faces.flatten(), normals), dim=1)
