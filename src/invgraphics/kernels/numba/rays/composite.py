"""Volume rendering of packed samples, forward and backward. Each job owns whole rays, so every sum has a fixed order."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.runtime import (
    array,
    index,
    inlined,
    parallel,
    power_minus_one,
    prange,
    threads,
)
from invgraphics.kernels.numba.segments import first_of_segment
from invgraphics.kernels.reference.composite import OPAQUE

_OPAQUE, _LOG2E = np.float32(OPAQUE), np.float32(1 / np.log(2.0))
_ZERO = np.float32(0.0)


@inlined
def interval_alpha(optical_depth):
    """Transmittance of one interval (float64, so that products of many stay exact) and alpha, its complement."""
    loss, scale = power_minus_one(-min(optical_depth, _OPAQUE) * _LOG2E)
    if scale == np.float32(1.0):
        # Nearly transparent: 1 - exp(-tau) without cancellation.
        return 1.0 + np.float64(loss), -loss
    transmitted = (loss + np.float32(1.0)) * scale
    return np.float64(transmitted), np.float32(1.0) - transmitted


@parallel
def accumulate(optical_depth, channels, ray, jobs, weights, after, sums, alpha):
    """Weights, transmittance behind each sample, and weighted sums per ray (``sums`` and ``alpha`` hold zeros before)."""
    width = channels.shape[1]
    for job in prange(jobs):
        transmittance, current = 1.0, np.int64(-1)
        for number in range(first_of_segment(ray, jobs, job), first_of_segment(ray, jobs, job + 1)):
            i = index(number)
            if ray[i] != current:
                transmittance, current = 1.0, ray[i]
            r = index(current)
            transmitted, alpha_i = interval_alpha(optical_depth[i])
            weight = np.float32(transmittance) * alpha_i
            transmittance *= transmitted
            weights[i], after[i] = weight, np.float32(transmittance)
            alpha[r] += weight
            for k in range(width):
                sums[r, index(k)] += weight * channels[i, index(k)]


@parallel
def accumulate_backward(channels, ray, weights, after, jobs, grad_weights, grad_sums, grad_alpha, grad_depth, grad_channels):
    """Gradients of optical depths and channels, back to front."""
    width = channels.shape[1]
    for job in prange(jobs):
        first, end = first_of_segment(ray, jobs, job), first_of_segment(ray, jobs, job + 1)
        behind, current = 0.0, np.int64(-1)
        for step in range(end - first):
            i = index(end - 1 - step)
            if ray[i] != current:
                behind, current = 0.0, ray[i]
            r = index(current)
            weight = weights[i]
            grad_weight = grad_weights[i] + grad_alpha[r]
            for number in range(width):
                k = index(number)
                grad_weight += grad_sums[r, k] * channels[i, k]
                grad_channels[i, k] = weight * grad_sums[r, k]
            # A denser sample contributes more itself and attenuates what is behind.
            grad_depth[i] = after[i] * grad_weight - np.float32(behind)
            behind += weight * grad_weight


class _Composite(torch.autograd.Function):
    """Differentiable in optical depths and channels."""

    @staticmethod
    def forward(ctx: Any, optical_depth: Tensor, channels: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor, Tensor]:
        weights, after = torch.empty(optical_depth.shape), torch.empty(optical_depth.shape)
        sums, alpha = torch.zeros(rays, channels.shape[1]), torch.zeros(rays)
        outputs = (x.numpy() for x in (weights, after, sums, alpha))
        accumulate(array(optical_depth), array(channels), array(ray.long()), threads(), *outputs)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(channels, ray, weights, after)
        ctx.rays = rays
        return weights, sums, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        grad_weights, grad_sums, grad_alpha = grad_outputs
        channels, ray, weights, after = ctx.saved_tensors
        shapes = (weights.shape, (ctx.rays, channels.shape[1]), (ctx.rays,))
        given = (grad_weights, grad_sums, grad_alpha)
        # Missing gradients are zero.
        received = [array(torch.zeros(shape) if g is None else g) for shape, g in zip(shapes, given, strict=True)]
        grad_depth, grad_channels = torch.empty(weights.shape), torch.empty(channels.shape)
        kept = (array(x) for x in (channels, ray.long(), weights, after))
        accumulate_backward(*kept, threads(), *received, grad_depth.numpy(), grad_channels.numpy())
        return grad_depth, grad_channels, None, None


def composite(
    optical_depth: Float[Tensor, " m"], channels: Float[Tensor, "m c"], ray: Int[Tensor, " m"], rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.composite`."""
    if len(ray) and not 0 <= int(ray[0]) <= int(ray[-1]) < rays:
        raise IndexError(f"Samples belong to rays {int(ray[0])} to {int(ray[-1])}, but there are {rays} rays.")
    return _Composite.apply(optical_depth, channels, ray, rays)
