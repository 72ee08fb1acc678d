"""Structural similarity and its gradient in one go, row by row (definition: `invgraphics.kernels.reference.ssim`).

A row of an (h, w, c) image is one flat array in which a pixel's neighbour lies c places away, so channels need no separation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.numba.runtime import (
    array,
    index,
    inlined,
    once_differentiable,
    parallel,
    prange,
    scratch,
    share,
    threads,
)
from invgraphics.kernels.reference.ssim import C1, C2, SIGMA, WINDOW

REACH = WINDOW // 2
_OFFSETS = np.arange(WINDOW) - REACH
_WINDOW = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)

_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


@inlined
def _add_moments(weight, x, y, mx, my, mxx, myy, mxy, margin):
    """Add a weighted row to the running moments, which have a margin at both ends."""
    for number in range(len(x)):
        i = index(number)
        at = i + margin
        a, b = x[i], y[i]
        wa, wb = weight * a, weight * b
        mx[at] += wa
        my[at] += wb
        mxx[at] += wa * a
        myy[at] += wb * b
        mxy[at] += wa * b


@inlined
def _add_row(weight, x, to, margin):
    for number in range(len(x)):
        i = index(number)
        to[i + margin] += weight * x[i]


@inlined
def _blur_along(row, channels, window, out):
    """Weighted mean along a row with margins."""
    for number in range(len(out)):
        i = index(number)
        total = _ZERO
        for k in range(WINDOW):
            total += window[index(k)] * row[i + index(k) * channels]
        out[i] = total


@inlined
def _compare(blurred, to_mean, to_variance, to_covariance):
    """Sum of a row's similarities; replaces the row's derivatives along mean, variance and covariance."""
    total = 0.0
    for number in range(blurred.shape[1]):
        i = index(number)
        mx, my = blurred[0, i], blurred[1, i]
        variances = blurred[2, i] - mx * mx + blurred[3, i] - my * my
        covariance = blurred[4, i] - mx * my
        a1, a2 = _TWO * mx * my + _C1, _TWO * covariance + _C2
        b1, b2 = mx * mx + my * my + _C1, variances + _C2
        inverse = _ONE / (b1 * b2)
        similarity = a1 * a2 * inverse
        along_variance, along_covariance = -similarity * b1 * inverse, _TWO * a1 * inverse
        # The mean enters the variance as -mx² and the covariance as -mx my.
        along_mean = _TWO * (my * a2 * inverse - mx * similarity * b2 * inverse - mx * along_variance) - my * along_covariance
        to_mean[i], to_variance[i], to_covariance[i] = along_mean, along_variance, along_covariance
        total += similarity
    return total


@parallel
def compare_rows(x, y, channels, window, jobs, derivatives, totals):
    """Sum of similarities per row, and the derivatives of each along the local mean, variance and covariance."""
    height, width = x.shape
    margin = index(REACH) * channels
    for job in prange(jobs):
        moments = np.zeros((5, width + 2 * REACH * channels), np.float32)
        blurred = np.empty((5, width), np.float32)
        for row in range(share(height, jobs, job), share(height, jobs, job + 1)):
            moments[:, REACH * channels : REACH * channels + width] = _ZERO
            for k in range(max(0, REACH - row), min(WINDOW, height + REACH - row)):
                r = row + k - REACH
                m = moments
                _add_moments(window[k], x[r], y[r], m[0], m[1], m[2], m[3], m[4], margin)
            for q in range(5):
                _blur_along(moments[q], index(channels), window, blurred[q])
            totals[row] = _compare(blurred, derivatives[0, row], derivatives[1, row], derivatives[2, row])


@inlined
def _combine(blurred, x, y, scale, out):
    """Chain rule from the blurred moments to the image: the blur is its own adjoint."""
    for number in range(len(out)):
        i = index(number)
        out[i] = scale * (blurred[0, i] + _TWO * x[i] * blurred[1, i] + y[i] * blurred[2, i])


@parallel
def gather_rows(x, y, channels, window, jobs, derivatives, gradient):
    """Gradient of the mean similarity along ``x``."""
    height, width = x.shape
    margin = index(REACH) * channels
    scale = np.float32(1.0 / (height * width))
    for job in prange(jobs):
        sums = np.zeros((3, width + 2 * REACH * channels), np.float32)
        blurred = np.empty((3, width), np.float32)
        for row in range(share(height, jobs, job), share(height, jobs, job + 1)):
            sums[:, REACH * channels : REACH * channels + width] = _ZERO
            for k in range(max(0, REACH - row), min(WINDOW, height + REACH - row)):
                for q in range(3):
                    _add_row(window[k], derivatives[q, row + k - REACH], sums[q], margin)
            for q in range(3):
                _blur_along(sums[q], index(channels), window, blurred[q])
            _combine(blurred, x[row], y[row], scale, gradient[row])


class _Ssim(torch.autograd.Function):
    """Differentiable in the first image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        height, width, channels = image.shape
        x, y = (array(picture).reshape(height, width * channels) for picture in (image, target))
        derivatives = scratch("ssim", 3 * x.size).reshape(3, *x.shape)
        totals = np.empty(height)
        compare_rows(x, y, index(channels), _WINDOW, threads(), derivatives, totals)
        if ctx.needs_input_grad[0]:
            gradient = torch.empty(image.shape)
            gather_rows(x, y, index(channels), _WINDOW, threads(), derivatives, gradient.numpy().reshape(x.shape))
            ctx.save_for_backward(gradient)
        return image.new_tensor(totals.sum() / max(x.size, 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (along,) = grad_outputs
        (gradient,) = ctx.saved_tensors
        return gradient * along, None


def ssim(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """See `invgraphics.kernels.ssim`."""
    return _Ssim.apply(image, target)
