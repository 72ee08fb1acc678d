"""`splat_project` as a torch function: EWA projection forward and backward by Triton kernels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import harmonics
from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.kernels import reference, types
from invgraphics.kernels.cuda.ewa import project
from invgraphics.kernels.cuda.ewa_backward import project_backward
from invgraphics.kernels.cuda.runtime import blocks, on_device_of
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.reference.splat_project import depth_plane_gradients

BLOCK = 128
"""Primitives per program."""
POSE = 12
"""Numbers of a pose's gradient: rotation row by row, position."""


class _Project(torch.autograd.Function):
    """Differentiable in means, quaternions, scales, sh and the camera's pose."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, sh: Tensor, pose: Tensor, *constants: Any
    ) -> tuple[Tensor, ...]:
        opacities, camera, dilation, antialiased = constants
        n = len(means)
        gaussians = tuple(tensor.contiguous() for tensor in (means, quaternions, scales, opacities, sh))
        view = torch.cat([pose[:3, :3].reshape(-1), pose[:3, 3], camera.focal, camera.principal_point]).to(means)
        means2d, conics, planes, rgb = (means.new_empty(n, width) for width in (2, 3, 3, 3))
        depths, radii, compensations = (means.new_empty(n) for _ in range(3))
        outputs = (means2d, conics, depths, planes, radii, rgb, compensations)
        ctx.shape = n, float(camera.width), float(camera.height), float(dilation)
        ctx.flags = {"DEGREE": harmonics.degree_of(sh.shape[1]), "ANTIALIASED": antialiased, "SIZE": BLOCK}
        if n:
            with on_device_of(means):
                project[(blocks(n, BLOCK),)](*gaussians, view, *ctx.shape, *outputs, **ctx.flags)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*gaussians, view, conics, radii, rgb, pose)
        ctx.camera = camera
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        means, quaternions, scales, opacities, sh, view, conics, radii, rgb, pose = ctx.saved_tensors
        grad_means2d, grad_conics, grad_depths, grad_planes, _, grad_rgb, grad_compensations = grad_outputs
        likes = (means[:, :2], conics, radii, rgb, radii)
        given = (grad_means2d, grad_conics, grad_depths, grad_rgb, grad_compensations)
        received = [torch.zeros_like(x) if g is None else g for x, g in zip(likes, given, strict=True)]
        results: list[Tensor | None] = [torch.empty_like(x) for x in (means, quaternions, scales, sh)]
        parts = means.new_zeros(blocks(len(means), BLOCK), POSE)
        if len(means):
            saved = (means, quaternions, scales, sh, view, conics, radii, rgb)
            with on_device_of(means):
                project_backward[(len(parts),)](
                    *saved, *ctx.shape, *(gradient.contiguous() for gradient in received), *results, parts, **ctx.flags
                )
        results.append(_pose_gradient(parts.sum(0), pose) if ctx.needs_input_grad[4] else None)
        if grad_planes is not None:
            gaussians = Gaussians(means, quaternions, scales, opacities, sh)
            extras = depth_plane_gradients(gaussians, ctx.camera, ctx.shape[3], grad_planes, radii)
            results = [own if own is None or extra is None else own + extra for own, extra in zip(results, extras, strict=True)]
        return (*results, None, None, None, None)


def _pose_gradient(total: Float[Tensor, " 12"], pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Gradient of ``cam_to_world``."""
    gradient = torch.zeros_like(pose)
    gradient[:3, :3], gradient[:3, 3] = total[:9].reshape(3, 3), total[9:]
    return gradient


def splat_project(
    gaussians: Gaussians, camera: Camera, dilation: float = 0.3, antialiased: bool = False
) -> tuple[types.Footprints, Float[Tensor, "n 3"]]:
    """See `invgraphics.kernels.splat_project`; optimised intrinsics are left to the reference."""
    if camera.focal.requires_grad or camera.principal_point.requires_grad:
        return reference.splat_project(gaussians, camera, dilation, antialiased)
    g = gaussians
    constants = (g.opacities.detach(), replace(camera, cam_to_world=camera.cam_to_world.detach()), dilation, antialiased)
    means2d, conics, depths, planes, radii, rgb, compensations = _Project.apply(
        g.means, g.quaternions, g.scales, g.sh, camera.cam_to_world, *constants
    )
    opacities = g.opacities * compensations if antialiased else g.opacities
    return types.Footprints(means2d, conics, opacities, depths, planes, radii), rgb
