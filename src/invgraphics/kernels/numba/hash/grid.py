"""Trilinear interpolation in a dense grid, forward and backward (definition: `invgraphics.kernels.reference.grid`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.numba.hash.cells import axis_cell, trilinear_weights
from invgraphics.kernels.numba.hash.jacobian import trilinear_gradient
from invgraphics.kernels.numba.runtime import array, index, inlined, job_start, once_differentiable, parallel, prange, threads

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _locate(point, shape):
    """Lower vertex, the steps to its upper neighbours (0 on an axis with a single vertex) and the fractions."""
    x, fx = axis_cell(point[0], shape[0] - 1)
    y, fy = axis_cell(point[1], shape[1] - 1)
    z, fz = axis_cell(point[2], shape[2] - 1)
    step_x, step_y, step_z = index(min(shape[0] - 1, 1)), index(min(shape[1] - 1, 1)), index(min(shape[2] - 1, 1))
    return (x, y, z), (step_x, step_y, step_z), (fx, fy, fz)


@inlined
def _rows(lower, step, shape):
    """Rows of the flattened grid that hold the 8 corners, x fastest."""
    sy, sz = index(shape[1]), index(shape[2])
    x0, x1 = lower[0] * sy, (lower[0] + step[0]) * sy
    y0, y1 = lower[1], lower[1] + step[1]
    z0, z1 = lower[2], lower[2] + step[2]
    a, b, c, d = (x0 + y0) * sz, (x1 + y0) * sz, (x0 + y1) * sz, (x1 + y1) * sz
    return a + z0, b + z0, c + z0, d + z0, a + z1, b + z1, c + z1, d + z1


@parallel
def sample(unit, grid, shape, jobs, out):
    """Interpolate the flattened grid (vertices, channels) at each point."""
    for job in prange(jobs):
        for number in range(job_start(len(unit), jobs, job), job_start(len(unit), jobs, job + 1)):
            i = index(number)
            lower, step, f = _locate(unit[i], shape)
            r, w = _rows(lower, step, shape), trilinear_weights(f)
            for channel in range(grid.shape[1]):
                k = index(channel)
                low = w[0] * grid[r[0], k] + w[1] * grid[r[1], k] + w[2] * grid[r[2], k] + w[3] * grid[r[3], k]
                high = w[4] * grid[r[4], k] + w[5] * grid[r[5], k] + w[6] * grid[r[6], k] + w[7] * grid[r[7], k]
                out[i, k] = low + high


@inlined
def _add(grad_grid, row, weight, gradient, i):
    for channel in range(gradient.shape[1]):
        k = index(channel)
        grad_grid[row, k] += weight * gradient[i, k]


@parallel
def sample_backward(unit, gradient, shape, jobs, grad_grid):
    """Gradient of the flattened grid. Each job owns a slab of vertices along x and accumulates its points in order."""
    layer = shape[1] * shape[2]
    for job in prange(jobs):
        first, end = index(job_start(shape[0], jobs, job)), index(job_start(shape[0], jobs, job + 1))
        grad_grid[first * index(layer) : end * index(layer)] = _ZERO
        for number in range(len(unit)):
            i = index(number)
            lower, step, f = _locate(unit[i], shape)
            if lower[0] + index(1) >= first and lower[0] < end:
                r, w = _rows(lower, step, shape), trilinear_weights(f)
                if first <= lower[0] < end:
                    _add(grad_grid, r[0], w[0], gradient, i)
                    _add(grad_grid, r[2], w[2], gradient, i)
                    _add(grad_grid, r[4], w[4], gradient, i)
                    _add(grad_grid, r[6], w[6], gradient, i)
                if first <= lower[0] + step[0] < end:
                    _add(grad_grid, r[1], w[1], gradient, i)
                    _add(grad_grid, r[3], w[3], gradient, i)
                    _add(grad_grid, r[5], w[5], gradient, i)
                    _add(grad_grid, r[7], w[7], gradient, i)


@parallel
def position_gradient(unit, grid, gradient, shape, jobs, grad_unit):
    """Gradient of the positions; zero on axes on which a position was clamped."""
    for job in prange(jobs):
        for number in range(job_start(len(unit), jobs, job), job_start(len(unit), jobs, job + 1)):
            i = index(number)
            lower, step, f = _locate(unit[i], shape)
            r = _rows(lower, step, shape)
            x = y = z = _ZERO
            for channel in range(grid.shape[1]):
                k = index(channel)
                v = (
                    grid[r[0], k], grid[r[1], k], grid[r[2], k], grid[r[3], k],
                    grid[r[4], k], grid[r[5], k], grid[r[6], k], grid[r[7], k],
                )  # fmt: skip
                sx, sy, sz = trilinear_gradient(v, f)
                g = gradient[i, k]
                x, y, z = x + g * sx, y + g * sy, z + g * sz
            grad_unit[i, 0], grad_unit[i, 1], grad_unit[i, 2] = x, y, z
            for a in range(3):
                inside = unit[i, a] >= _ZERO and unit[i, a] <= _ONE
                grad_unit[i, a] = grad_unit[i, a] * np.float32(shape[a] - 1) if inside else _ZERO


class _Sample(torch.autograd.Function):
    """Differentiable in positions and grid."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, grid: Tensor) -> Tensor:
        out = unit.new_empty(len(unit), grid.shape[3])
        sample(array(unit), _flat(grid), tuple(grid.shape[:3]), threads(), out.numpy())
        ctx.save_for_backward(unit, grid)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (gradient,) = grad_outputs
        unit, grid = ctx.saved_tensors
        points, received, shape = array(unit), array(gradient), tuple(grid.shape[:3])
        grad_unit = grad_grid = None
        if ctx.needs_input_grad[0]:
            grad_unit = torch.empty(unit.shape)
            position_gradient(points, _flat(grid), received, shape, threads(), grad_unit.numpy())
        if ctx.needs_input_grad[1]:
            grad_grid = torch.empty(grid.shape)
            sample_backward(points, received, shape, threads(), grad_grid.numpy().reshape(-1, grid.shape[3]))
        return grad_unit, grad_grid


def _flat(grid: Tensor) -> np.ndarray:
    """The grid as (vertices, channels)."""
    return array(grid).reshape(-1, grid.shape[3])


def grid_sample(unit: Float[Tensor, "m 3"], grid: Float[Tensor, "x y z c"]) -> Float[Tensor, "m c"]:
    """See `invgraphics.kernels.grid_sample`."""
    return _Sample.apply(unit, grid)
