"""Multi-resolution hash encoding, forward and backward (definition and judge: `invgraphics.kernels.reference.hash`)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import reference
from invgraphics.kernels.differentiation import once_differentiable, positions_only
from invgraphics.kernels.numba.hash.blocks import TWO, block_at, gather_block, scatter_block
from invgraphics.kernels.numba.hash.cells import BLOCK, CHUNK, ZERO, locate_block, prefetch_entries
from invgraphics.kernels.numba.hash.jacobian import encode_jvp, encode_jvp_backward, hessian_product, position_gradient
from invgraphics.kernels.numba.runtime import array, index, job_start, parallel, prange, threads


@parallel
def encode(positions, table, width, cells, offsets, masks, jobs, out):
    """Features of all levels at each point; ``positions`` is (3, m), ``table`` flat."""
    x, y, z = positions[0], positions[1], positions[2]
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        begin, end = job_start(len(x), jobs, job), job_start(len(x), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            until = min(chunk + CHUNK, end)
            for number in range(len(cells)):
                level, column = (cells[number], offsets[number], masks[number]), index(number) * width
                for first in range(chunk, until + BLOCK, BLOCK):
                    # Software pipelining: a block's entries are prefetched before those of the previous block are read.
                    if first < until:
                        block, place = block_at(first, until), first // BLOCK % 2
                        locate_block(x, y, z, block, level, entries[place], weights[place])
                        if width == TWO:
                            prefetch_entries(table, entries[place], block[1])
                    if first > chunk:
                        block, place = block_at(first - BLOCK, until), (first // BLOCK - 1) % 2
                        gather_block(table, entries[place], weights[place], block, column, width, out)


@parallel
def encode_backward(positions, gradient, width, cells, offsets, masks, jobs, grad_table):
    """Gradient of the table. Each job owns every ``jobs``-th level, so no entry is written by two of them."""
    x, y, z = positions[0], positions[1], positions[2]
    for job in prange(jobs):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        for number in range(job, len(cells), jobs):
            level, column = (cells[number], offsets[number], masks[number]), index(number) * width
            grad_table[index(offsets[number]) * width : index(offsets[number + 1]) * width] = ZERO
            for first in range(0, len(x), BLOCK):
                block = block_at(first, len(x))
                locate_block(x, y, z, block, level, entries, weights)
                scatter_block(gradient, entries, weights, block, column, width, grad_table)


@cache
def levels_of(grid: HashGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per level: cells along an edge, first entry, and hash mask (0 on dense levels)."""
    cells = np.array(grid.resolutions, np.int64)
    hashed = (cells + 1) ** 3 > 2**grid.log2_size
    return cells, np.array(grid.offsets, np.int64), np.where(hashed, 2**grid.log2_size - 1, 0).astype(np.uint64)


def _by_axis(unit: Tensor) -> np.ndarray:
    """Positions as structure of arrays (3, m), for SIMD loads."""
    return array(unit.T)


class _Encode(torch.autograd.Function):
    """Differentiable in positions and table, twice."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
        width = table.shape[1]
        out = unit.new_empty(len(unit), grid.levels * width)
        encode(_by_axis(unit), array(table).reshape(-1), index(width), *levels_of(grid), threads(), out.numpy())
        ctx.save_for_backward(unit, table)
        ctx.grid, ctx.positions_only = grid, positions_only()
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (gradient,) = grad_outputs
        unit, table = ctx.saved_tensors
        wants_table = ctx.needs_input_grad[1] and not ctx.positions_only
        grad_table = _TableGradient.apply(unit, gradient, table.shape, ctx.grid) if wants_table else None
        unit = unit.detach() if ctx.positions_only else unit
        grad_unit = _PositionGradient.apply(unit, table, gradient, ctx.grid) if ctx.needs_input_grad[0] else None
        return grad_unit, grad_table, None


class _PositionGradient(torch.autograd.Function):
    """Gradient of the positions, itself differentiable."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, gradient: Tensor, grid: HashGrid) -> Tensor:
        ctx.save_for_backward(unit, table, gradient)
        ctx.grid, by_axis, width = grid, torch.empty(3, len(unit)), index(table.shape[1])
        flat = array(table).reshape(-1)
        position_gradient(_by_axis(unit), flat, array(gradient), width, *levels_of(grid), threads(), by_axis.numpy())
        return by_axis.T.contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, table, gradient = ctx.saved_tensors
        along = torch.where((unit >= 0) & (unit <= 1), grad_outputs[0], 0.0)
        points, direction, width, levels = _by_axis(unit), _by_axis(along), index(table.shape[1]), levels_of(ctx.grid)
        grad_unit = grad_table = grad_cotangent = None
        if ctx.needs_input_grad[0]:
            by_axis, flat = torch.empty(3, len(unit)), array(table).reshape(-1)
            hessian_product(points, flat, array(gradient), direction, width, *levels, threads(), by_axis.numpy())
            grad_unit = torch.where((unit >= 0) & (unit <= 1), by_axis.T, 0.0)
        if ctx.needs_input_grad[1]:
            grad_table = torch.empty(table.shape)
            encode_jvp_backward(points, array(gradient), direction, width, *levels, threads(), grad_table.numpy().reshape(-1))
        if ctx.needs_input_grad[2]:
            grad_cotangent = torch.empty(gradient.shape)
            encode_jvp(points, array(table).reshape(-1), direction, width, *levels, threads(), grad_cotangent.numpy())
        return grad_unit, grad_table, grad_cotangent, None


class _TableGradient(torch.autograd.Function):
    """Gradient of the table, linear in the cotangent; itself differentiable."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, gradient: Tensor, shape: torch.Size, grid: HashGrid) -> Tensor:
        grad_table = torch.empty(shape)
        flat = grad_table.numpy().reshape(-1)
        encode_backward(_by_axis(unit), array(gradient), index(shape[1]), *levels_of(grid), threads(), flat)
        ctx.save_for_backward(unit, gradient)
        ctx.grid = grid
        return grad_table

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        """A direction in the table times its gradient is the cotangent times the features of that direction."""
        (along,), (unit, gradient) = grad_outputs, ctx.saved_tensors
        grad_unit = _PositionGradient.apply(unit, along, gradient, ctx.grid) if ctx.needs_input_grad[0] else None
        grad_cotangent = _Encode.apply(unit, along, ctx.grid) if ctx.needs_input_grad[1] else None
        return grad_unit, grad_cotangent, None, None


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """See `invgraphics.kernels.hash_encode`; the Jacobian is left to the reference."""
    if jacobian:
        return reference.hash_encode(unit, table, grid, jacobian)
    return _Encode.apply(unit, table, grid), None
