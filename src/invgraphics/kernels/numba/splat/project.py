"""`splat_project` as a torch function: EWA projection forward and backward."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.kernels import reference
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.runtime import array, threads
from invgraphics.kernels.numba.splat.ewa import CENTRE, FOCAL, POSITION, SIZE, VIEW, project
from invgraphics.kernels.numba.splat.ewa_backward import project_backward
from invgraphics.kernels.reference.splat_project import depth_plane_gradients
from invgraphics.kernels.types import Footprints


class _Project(torch.autograd.Function):
    """Differentiable in means, quaternions, scales, sh and the camera's pose."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, sh: Tensor, pose: Tensor, *constants: Any
    ) -> tuple[Tensor, ...]:
        opacities, camera, dilation, antialiased = constants
        n = len(means)
        view = _flatten_camera(camera)
        means2d, conics, rgb = means.new_empty(n, 2), means.new_empty(n, 3), means.new_empty(n, 3)
        depths, depth_planes, radii, compensations = (
            means.new_empty(n),
            means.new_empty(n, 3),
            means.new_empty(n),
            means.new_empty(n),
        )
        outputs = (means2d, conics, depths, depth_planes, radii, rgb, compensations)
        inputs = (array(x) for x in (means, quaternions, scales, opacities, sh))
        project(view, np.float32(dilation), antialiased, *inputs, threads(), *(output.numpy() for output in outputs))
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(means, quaternions, scales, sh, opacities, conics, radii, rgb, pose)
        ctx.view, ctx.camera, ctx.dilation, ctx.antialiased = view, camera, dilation, antialiased
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        means, quaternions, scales, sh, opacities, conics, radii, rgb, pose = ctx.saved_tensors
        grad_means2d, grad_conics, grad_depths, grad_planes, _, grad_rgb, grad_compensations = grad_outputs
        likes = (means[:, :2], conics, radii, rgb, radii)
        given = (grad_means2d, grad_conics, grad_depths, grad_rgb, grad_compensations)
        # Missing gradients are zero.
        received = [torch.zeros(x.shape) if g is None else g for x, g in zip(likes, given, strict=True)]
        results = [torch.empty(x.shape) for x in (means, quaternions, scales, sh)]
        pose_sums = np.empty((threads(), 12))
        inputs = (array(x) for x in (means, quaternions, scales, sh, radii, conics, rgb))
        outputs = (result.numpy() for result in results)
        project_backward(
            ctx.view, np.float32(ctx.dilation), ctx.antialiased, *inputs, *map(array, received), *outputs, pose_sums
        )
        grad_pose = _pose_gradient(pose_sums, pose) if ctx.needs_input_grad[4] else None
        if grad_planes is not None:
            gaussians = Gaussians(means, quaternions, scales, opacities, sh)
            extras = depth_plane_gradients(gaussians, ctx.camera, ctx.dilation, grad_planes, radii)
            for result, extra in zip((*results, grad_pose), extras, strict=True):
                if result is not None and extra is not None:
                    result.add_(extra)
        return (*results, grad_pose, None, None, None, None)


def _flatten_camera(camera: Camera) -> tuple[np.float32, ...]:
    """The camera as the flat tuple that `project` reads (layout in `ewa`)."""
    view = np.empty(VIEW, np.float32)
    pose = array(camera.cam_to_world)
    view[:POSITION], view[POSITION:FOCAL] = pose[:3, :3].reshape(-1), pose[:3, 3]
    view[FOCAL:CENTRE], view[CENTRE:SIZE] = array(camera.focal), array(camera.principal_point)
    view[SIZE:] = camera.width, camera.height
    return tuple(view)


def _pose_gradient(jobs: np.ndarray, pose: Tensor) -> Tensor:
    """Gradient of ``cam_to_world`` (4, 4), reduced over jobs."""
    total = jobs.sum(axis=0)
    gradient = np.zeros((4, 4))
    gradient[:3, :3], gradient[:3, 3] = total[:9].reshape(3, 3), total[9:]
    return torch.from_numpy(gradient).to(pose)


def splat_project(
    gaussians: Gaussians, camera: Camera, dilation: float = 0.3, antialiased: bool = False
) -> tuple[Footprints, Float[Tensor, "n 3"]]:
    """See `invgraphics.kernels.splat_project`; optimised intrinsics are left to the reference."""
    if camera.focal.requires_grad or camera.principal_point.requires_grad:
        return reference.splat_project(gaussians, camera, dilation, antialiased)
    g = gaussians
    constants = (g.opacities.detach(), replace(camera, cam_to_world=camera.cam_to_world.detach()), dilation, antialiased)
    means2d, conics, depths, depth_planes, radii, rgb, compensations = _Project.apply(
        g.means, g.quaternions, g.scales, g.sh, camera.cam_to_world, *constants
    )
    opacities = g.opacities * compensations if antialiased else g.opacities
    return Footprints(means2d, conics, opacities, depths, depth_planes, radii), rgb
