"""Rasterisation of triangle meshes, dispatched as the operations in `invgraphics.kernels`."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.types import Fragments

Interval = tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]


def mesh_rasterise(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera, interval: Interval | None = None
) -> Fragments:
    """Z-buffer rasterisation of triangles at pixel centres, by homogeneous edge functions (Olano and Greer 1997).

    Triangles are seen from both sides. Those that cross the camera's plane need no clipping: a hit is the intersection of the
    pixel's ray, and counts within ``interval``. Pixels on an edge belong to the triangle; of two triangles at the same
    depth, the first one wins.

    Args:
        vertices: positions in the camera's world frame.
        faces: indices of the corners.
        camera: pinhole camera.
        interval: nearest and farthest distance along each pixel's unit ray; ``None`` for all in front of the camera.

    Returns:
        Nearest hits. Not differentiable: `kernels.reference.mesh.hit` repeats the intersection with gradients.
    """
    return choose("mesh_rasterise", vertices)(vertices, faces, camera, interval)


def mesh_interpolate(fragments: Fragments, faces: Int[Tensor, "f 3"], features: Float[Tensor, "v c"]) -> Float[Tensor, "h w c"]:
    """Barycentric interpolation of vertex features at fragments; zero where there is none.

    Linear in ``features``: its backward pass is the transposed gather. Also differentiable in ``fragments.barycentric``.

    Args:
        fragments: of `mesh_rasterise`.
        faces: of the same mesh.
        features: per vertex.
    """
    if fragments.barycentric.shape != (*fragments.face.shape, 3):
        raise ValueError(f"Fragments of {tuple(fragments.face.shape)} have weights of {tuple(fragments.barycentric.shape)}.")
    return choose("mesh_interpolate", features, fragments.barycentric)(fragments, faces, features)
