"""Volume rendering of packed samples in Triton. Each program owns a ray, so every sum has one writer and a fixed order."""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.cuda.runtime import at_least_2, on_device_of
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.reference.composite import OPAQUE

_OPAQUE = tl.constexpr(OPAQUE)

SIZE = 32
"""Samples per iteration of a program: one per lane of a warp."""


@triton.jit
def _alpha(tau):
    """``1 - exp(-tau)`` without cancellation."""
    # Five terms of the series are exact to 2e-8 where they are used.
    series = tau * (1 - tau / 2 * (1 - tau / 3 * (1 - tau / 4 * (1 - tau / 5))))
    return tl.where(tau < 0.1, series, 1 - tl.exp(-tau))


@triton.jit
def _limited(tau):
    """Optical depths, at most `OPAQUE`; NaN stays, which ``tl.minimum`` would take for the limit."""
    return tl.where(tau > _OPAQUE, _OPAQUE, tau)


@triton.jit
def accumulate(
    depth, channels, first, weights, after, sums, alpha, width, WIDTH: tl.constexpr, SIZE: tl.constexpr
):  # fmt: skip
    """Weights, transmittance behind each sample, and the sums of a ray, whose samples are ``first[ray] .. first[ray + 1]``."""
    ray = tl.program_id(0).to(tl.int64)
    begin, end = tl.load(first + ray), tl.load(first + ray + 1)
    lane, column = tl.arange(0, SIZE), tl.arange(0, WIDTH)
    total, optical, opacity = tl.zeros((WIDTH,), tl.float32), 0.0, 0.0
    for start in range(begin, end, SIZE):
        sample = start + lane
        in_range = sample < end
        tau = _limited(tl.load(depth + sample, mask=in_range, other=0.0))
        # An exclusive scan of its own: subtracting a large tau from an inclusive one would cancel all digits.
        nearer = _limited(tl.load(depth + sample - 1, mask=in_range & (lane > 0), other=0.0))
        before = optical + tl.cumsum(nearer, axis=0)
        weight = tl.exp(-before) * _alpha(tau)
        valid = in_range[:, None] & (column < width)[None, :]
        values = tl.load(channels + sample[:, None] * width + column[None, :], mask=valid, other=0.0)
        total += tl.sum(weight[:, None] * values, axis=0)
        opacity += tl.sum(weight, axis=0)
        optical += tl.sum(tau, axis=0)
        tl.store(weights + sample, weight, mask=in_range)
        tl.store(after + sample, tl.exp(-(before + tau)), mask=in_range)
    tl.store(sums + ray * width + column, total, mask=column < width)
    tl.store(alpha + ray, opacity)


@triton.jit
def accumulate_backward(
    channels, first, weights, after, grad_weights, grad_sums, grad_alpha, grad_depth, grad_channels, width,
    WIDTH: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Gradients of one ray's optical depths and channels, back to front."""
    ray = tl.program_id(0).to(tl.int64)
    begin, end = tl.load(first + ray), tl.load(first + ray + 1)
    lane, column = tl.arange(0, SIZE), tl.arange(0, WIDTH)
    grad_sum = tl.load(grad_sums + ray * width + column, mask=column < width, other=0.0)
    grad_opacity = tl.load(grad_alpha + ray)
    behind = 0.0
    for turn in range((end - begin + SIZE - 1) // SIZE):
        sample = end - (turn + 1) * SIZE + lane
        in_range = sample >= begin
        valid = in_range[:, None] & (column < width)[None, :]
        weight = tl.load(weights + sample, mask=in_range, other=0.0)
        values = tl.load(channels + sample[:, None] * width + column[None, :], mask=valid, other=0.0)
        grad_weight = (
            tl.load(grad_weights + sample, mask=in_range, other=0.0) + grad_opacity + tl.sum(grad_sum[None, :] * values, axis=1)
        )
        share = tl.where(in_range, weight * grad_weight, 0.0)
        # A denser sample contributes more itself and attenuates what is behind.
        hidden = behind + tl.sum(share, axis=0) - tl.cumsum(share, axis=0)
        transmitted = tl.load(after + sample, mask=in_range, other=0.0)
        tl.store(grad_depth + sample, transmitted * grad_weight - hidden, mask=in_range)
        tl.store(grad_channels + sample[:, None] * width + column[None, :], weight[:, None] * grad_sum[None, :], mask=valid)
        behind += tl.sum(share, axis=0)


class _Composite(torch.autograd.Function):
    """Differentiable in optical depths and channels."""

    @staticmethod
    def forward(ctx: Any, optical_depth: Tensor, channels: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor, Tensor]:
        optical_depth, channels = optical_depth.contiguous(), channels.contiguous()
        first = torch.nn.functional.pad(torch.bincount(ray, minlength=rays).cumsum(0), (1, 0))
        weights, after = torch.empty_like(optical_depth), torch.empty_like(optical_depth)
        sums, alpha = channels.new_zeros(rays, channels.shape[1]), channels.new_zeros(rays)
        ctx.sizes = (channels.shape[1], at_least_2(channels.shape[1]), SIZE)
        if rays:
            with on_device_of(channels):
                accumulate[(rays,)](optical_depth, channels, first, weights, after, sums, alpha, *ctx.sizes, num_warps=1)
        ctx.save_for_backward(channels, first, weights, after)
        return weights, sums, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        channels, first, weights, after = ctx.saved_tensors
        cotangents = (gradient.contiguous() for gradient in grad_outputs)
        grad_depth, grad_channels = torch.empty_like(weights), torch.empty_like(channels)
        rays = len(first) - 1
        if rays:
            with on_device_of(channels):
                accumulate_backward[(rays,)](
                    channels, first, weights, after, *cotangents, grad_depth, grad_channels, *ctx.sizes, num_warps=1
                )
        return grad_depth, grad_channels, None, None


def composite(
    optical_depth: Float[Tensor, " m"], channels: Float[Tensor, "m c"], ray: Int[Tensor, " m"], rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.composite`."""
    return _Composite.apply(optical_depth, channels, ray, rays)
