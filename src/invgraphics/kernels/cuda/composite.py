"""Emission-absorption along packed rays in Triton. Each program owns a ray, so every sum has one writer and a fixed order."""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.cuda.runtime import at_least_2, on_device_of, once_differentiable
from invgraphics.kernels.reference.composite import OPAQUE

_OPAQUE = tl.constexpr(OPAQUE)

SIZE = 32
"""Samples that a program takes at once: one per lane of a warp."""


@triton.jit
def _absorbed(tau):
    """``1 - exp(-tau)`` without cancellation."""
    # Five terms of the series are exact to 2e-8 where they are used.
    series = tau * (1 - tau / 2 * (1 - tau / 3 * (1 - tau / 4 * (1 - tau / 5))))
    return tl.where(tau < 0.1, series, 1 - tl.exp(-tau))


@triton.jit
def accumulate(
    depth, channels, first, weights, after, sums, alpha, width, WIDTH: tl.constexpr, SIZE: tl.constexpr
):  # fmt: skip
    """Weights, transmittance behind each sample, and the sums of a ray, whose samples are ``first[ray] .. first[ray + 1]``."""
    ray = tl.program_id(0).to(tl.int64)
    begin, end = tl.load(first + ray), tl.load(first + ray + 1)
    lane, column = tl.arange(0, SIZE), tl.arange(0, WIDTH)
    total, passed, covered = tl.zeros((WIDTH,), tl.float32), 0.0, 0.0
    for start in range(begin, end, SIZE):
        sample = start + lane
        there = sample < end
        tau = tl.minimum(tl.load(depth + sample, mask=there, other=0.0), _OPAQUE)
        # What lies in front is summed by itself: taking a large tau away from a running sum would leave no digits.
        nearer = tl.minimum(tl.load(depth + sample - 1, mask=there & (lane > 0), other=0.0), _OPAQUE)
        before = passed + tl.cumsum(nearer, axis=0)
        weight = tl.exp(-before) * _absorbed(tau)
        wanted = there[:, None] & (column < width)[None, :]
        values = tl.load(channels + sample[:, None] * width + column[None, :], mask=wanted, other=0.0)
        total += tl.sum(weight[:, None] * values, axis=0)
        covered += tl.sum(weight, axis=0)
        passed += tl.sum(tau, axis=0)
        tl.store(weights + sample, weight, mask=there)
        tl.store(after + sample, tl.exp(-(before + tau)), mask=there)
    tl.store(sums + ray * width + column, total, mask=column < width)
    tl.store(alpha + ray, covered)


@triton.jit
def accumulate_back(
    channels, first, weights, after, to_weights, to_sums, to_alpha, to_depth, to_channels, width,
    WIDTH: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Gradients of one ray, from its far end to its near one."""
    ray = tl.program_id(0).to(tl.int64)
    begin, end = tl.load(first + ray), tl.load(first + ray + 1)
    lane, column = tl.arange(0, SIZE), tl.arange(0, WIDTH)
    pull = tl.load(to_sums + ray * width + column, mask=column < width, other=0.0)
    cover = tl.load(to_alpha + ray)
    behind = 0.0
    for turn in range((end - begin + SIZE - 1) // SIZE):
        sample = end - (turn + 1) * SIZE + lane
        there = sample >= begin
        wanted = there[:, None] & (column < width)[None, :]
        weight = tl.load(weights + sample, mask=there, other=0.0)
        values = tl.load(channels + sample[:, None] * width + column[None, :], mask=wanted, other=0.0)
        gain = tl.load(to_weights + sample, mask=there, other=0.0) + cover + tl.sum(pull[None, :] * values, axis=1)
        share = tl.where(there, weight * gain, 0.0)
        # A denser sample takes from the light that passes it and hides what is behind.
        hidden = behind + tl.sum(share, axis=0) - tl.cumsum(share, axis=0)
        passed = tl.load(after + sample, mask=there, other=0.0)
        tl.store(to_depth + sample, passed * gain - hidden, mask=there)
        tl.store(to_channels + sample[:, None] * width + column[None, :], weight[:, None] * pull[None, :], mask=wanted)
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
        received = (gradient.contiguous() for gradient in grad_outputs)
        to_depth, to_channels = torch.empty_like(weights), torch.empty_like(channels)
        rays = len(first) - 1
        if rays:
            with on_device_of(channels):
                accumulate_back[(rays,)](
                    channels, first, weights, after, *received, to_depth, to_channels, *ctx.sizes, num_warps=1
                )
        return to_depth, to_channels, None, None


def composite(
    optical_depth: Float[Tensor, " m"], channels: Float[Tensor, "m c"], ray: Int[Tensor, " m"], rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.composite`."""
    return _Composite.apply(optical_depth, channels, ray, rays)
