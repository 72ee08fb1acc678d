"""Barycentric interpolation of vertex features at fragments, and its transpose, in a fixed order of sums."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.mesh.rasterise import check_faces
from invgraphics.kernels.numba.runtime import array, job_start, parallel, prange, serial, threads
from invgraphics.kernels.types import Fragments


@parallel
def gather(face, barycentric, faces, features, jobs, out):
    """Weighted sums of features at each pixel's corners (``out`` holds zeros before)."""
    width = features.shape[1]
    for job in prange(jobs):
        for i in range(job_start(len(face), jobs, job), job_start(len(face), jobs, job + 1)):
            if face[i] >= 0:
                for corner in range(3):
                    weight, v = barycentric[i, corner], faces[face[i], corner]
                    for k in range(width):
                        out[i, k] += weight * features[v, k]


@serial
def scatter(face, barycentric, faces, gradient, out):
    """Transpose of `gather`: gradients of the features, summed pixel by pixel."""
    width = gradient.shape[1]
    for i in range(len(face)):
        if face[i] >= 0:
            for corner in range(3):
                weight, v = barycentric[i, corner], faces[face[i], corner]
                for k in range(width):
                    out[v, k] += weight * gradient[i, k]


@parallel
def weight_gradients(face, faces, features, gradient, jobs, out):
    """Gradients of the barycentric coordinates (``out`` holds zeros before)."""
    width = features.shape[1]
    for job in prange(jobs):
        for i in range(job_start(len(face), jobs, job), job_start(len(face), jobs, job + 1)):
            if face[i] >= 0:
                for corner in range(3):
                    v = faces[face[i], corner]
                    for k in range(width):
                        out[i, corner] += gradient[i, k] * features[v, k]


class _Interpolate(torch.autograd.Function):
    """Differentiable in features and barycentric coordinates."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, barycentric: Tensor, face: Tensor, faces: Tensor) -> Tensor:
        out = torch.zeros(len(face), features.shape[1])
        gather(array(face), array(barycentric), array(faces), array(features), threads(), out.numpy())
        ctx.save_for_backward(features, barycentric, face, faces)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        features, barycentric, face, faces = ctx.saved_tensors
        gradient = array(gradients[0])
        to_features, to_weights = None, None
        if ctx.needs_input_grad[0]:
            to_features = torch.zeros_like(features, memory_format=torch.contiguous_format)
            scatter(array(face), array(barycentric), array(faces), gradient, to_features.numpy())
        if ctx.needs_input_grad[1]:
            to_weights = torch.zeros(barycentric.shape)
            weight_gradients(array(face), array(faces), array(features), gradient, threads(), to_weights.numpy())
        return to_features, to_weights, None, None


def mesh_interpolate(fragments: Fragments, faces: Int[Tensor, "f 3"], features: Float[Tensor, "v c"]) -> Float[Tensor, "h w c"]:
    """See `invgraphics.kernels.mesh_interpolate`."""
    check_faces(faces, len(features))
    if fragments.face.numel() and int(fragments.face.max()) >= len(faces):
        raise IndexError(f"Fragments are of faces up to {int(fragments.face.max())}, but there are {len(faces)} faces.")
    flat = _Interpolate.apply(features, fragments.barycentric.reshape(-1, 3), fragments.face.reshape(-1), faces.long())
    return flat.view(*fragments.face.shape, features.shape[1])
