"""SSIM and its gradient by separable blurs, row by row (definition and judge: `invgraphics.kernels.reference.ssim`).

A row of an (h, w, c) image is a flat array in which a pixel's neighbour lies at stride c, so channels need no separation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.runtime import (
    GROUP,
    array,
    index,
    inlined,
    job_start,
    parallel,
    prange,
    scratch,
    threads,
)
from invgraphics.kernels.numba.simd.lanes import broadcast, lane_index, load, reduce_sum, store, where
from invgraphics.kernels.reference.ssim import C1, C2, SIGMA, WINDOW

RADIUS = WINDOW // 2
_OFFSETS = np.arange(WINDOW) - RADIUS
_WINDOW = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)

_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


@inlined
def _register_start(begin, width):
    """Start of the register at ``begin``; the row's last register starts earlier and overlaps the one before it."""
    return index(min(begin, width - GROUP))


@inlined
def _window_rows(row, height):
    """Range of window rows, around an image row, that lie in the image."""
    return max(0, RADIUS - row), min(WINDOW, height + RADIUS - row)


@inlined
def _blur_row(row, at, channels, window):
    """Horizontal blur of a flat row with margins."""
    sums = broadcast(_ZERO)
    for k in range(WINDOW):
        sums += window[index(k)] * load(row, at + index(k) * channels)
    return sums


@inlined
def _ssim_with_derivatives(mx, my, squares, product):
    """SSIM from the local means of x, y, x² + y² and x y; and its derivatives in mean, variance and covariance."""
    variances, covariance = squares - mx * mx - my * my, product - mx * my
    a1, a2 = _TWO * mx * my + _C1, _TWO * covariance + _C2
    b1, b2 = mx * mx + my * my + _C1, variances + _C2
    inverse = _ONE / (b1 * b2)
    similarity = a1 * a2 * inverse
    along_variance, along_covariance = -similarity * b1 * inverse, _TWO * a1 * inverse
    # The mean enters the variance as -mx² and the covariance as -mx my.
    along_mean = _TWO * (my * a2 * inverse - mx * similarity * b2 * inverse - mx * along_variance) - my * along_covariance
    return similarity, along_mean, along_variance, along_covariance


@parallel
def ssim_rows(x, y, channels, window, jobs, derivatives, totals):
    """Forward: sum of SSIM per row, and its derivatives in the local mean, variance and covariance of every pixel."""
    height, width = x.shape
    margin = index(RADIUS) * channels
    stride, plane = index(width) + margin + margin, index(height) * index(width)
    for job in prange(jobs):
        moments = np.zeros(4 * stride, np.float32)
        for row in range(job_start(height, jobs, job), job_start(height, jobs, job + 1)):
            first, past = _window_rows(row, height)
            for begin in range(0, width, GROUP):
                i = _register_start(begin, width)
                mx = my = squares = product = broadcast(_ZERO)
                for k in range(first, past):
                    at = index(row + k - RADIUS) * index(width) + i
                    a, b, weight = load(x, at), load(y, at), window[index(k)]
                    wa, wb = weight * a, weight * b
                    mx, my, squares, product = mx + wa, my + wb, squares + wa * a + wb * b, product + wa * b
                at = i + margin
                store(moments, at, mx)
                store(moments, at + stride, my)
                store(moments, at + stride + stride, squares)
                store(moments, at + stride + stride + stride, product)
            sums = broadcast(_ZERO)
            for begin in range(0, width, GROUP):
                i = _register_start(begin, width)
                mx, my = _blur_row(moments, i, channels, window), _blur_row(moments, i + stride, channels, window)
                squares = _blur_row(moments, i + stride + stride, channels, window)
                product = _blur_row(moments, i + stride + stride + stride, channels, window)
                similarity, along_mean, along_variance, along_covariance = _ssim_with_derivatives(mx, my, squares, product)
                at = index(row) * index(width) + i
                store(derivatives, at, along_mean)
                store(derivatives, at + plane, along_variance)
                store(derivatives, at + plane + plane, along_covariance)
                # Lanes that overlap the previous register are left out.
                sums += where(lane_index() >= np.float32(begin - np.int64(i)), similarity, _ZERO)
            totals[row] = reduce_sum(sums)


@parallel
def gradient_rows(x, y, channels, window, jobs, derivatives, gradient):
    """Gradient of the mean SSIM in ``x``: the blur is its own adjoint."""
    height, width = x.shape
    margin = index(RADIUS) * channels
    stride, plane = index(width) + margin + margin, index(height) * index(width)
    scale = np.float32(1.0 / (height * width))
    for job in prange(jobs):
        sums = np.zeros(3 * stride, np.float32)
        for row in range(job_start(height, jobs, job), job_start(height, jobs, job + 1)):
            first, past = _window_rows(row, height)
            for begin in range(0, width, GROUP):
                i = _register_start(begin, width)
                mean = variance = covariance = broadcast(_ZERO)
                for k in range(first, past):
                    at, weight = index(row + k - RADIUS) * index(width) + i, window[index(k)]
                    mean += weight * load(derivatives, at)
                    variance += weight * load(derivatives, at + plane)
                    covariance += weight * load(derivatives, at + plane + plane)
                at = i + margin
                store(sums, at, mean)
                store(sums, at + stride, variance)
                store(sums, at + stride + stride, covariance)
            for begin in range(0, width, GROUP):
                i = _register_start(begin, width)
                mean, variance = _blur_row(sums, i, channels, window), _blur_row(sums, i + stride, channels, window)
                covariance = _blur_row(sums, i + stride + stride, channels, window)
                at = index(row) * index(width) + i
                store(gradient, at, scale * (mean + _TWO * load(x, at) * variance + load(y, at) * covariance))


class _Ssim(torch.autograd.Function):
    """Differentiable in the first image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        height, width, channels = image.shape
        x, y = (array(picture).reshape(height, width * channels) for picture in (image, target))
        derivatives = scratch("ssim", 3 * x.size).reshape(3, *x.shape)
        totals = np.empty(height)
        ssim_rows(x, y, index(channels), _WINDOW, threads(), derivatives, totals)
        if ctx.needs_input_grad[0]:
            gradient = torch.empty(image.shape)
            gradient_rows(x, y, index(channels), _WINDOW, threads(), derivatives, gradient.numpy().reshape(x.shape))
            ctx.save_for_backward(gradient)
        return image.new_tensor(totals.sum() / max(x.size, 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (along,) = grad_outputs
        (gradient,) = ctx.saved_tensors
        return gradient * along, None


def ssim(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """See `invgraphics.kernels.ssim`; images narrower than a register are left to the reference."""
    if image.shape[1] * image.shape[2] < GROUP:
        return reference.ssim(image, target)
    return _Ssim.apply(image, target)
