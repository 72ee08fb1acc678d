"""Multi-resolution hash encoding: positions and indices as in `invgraphics.kernels.reference.hash`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import reference
from invgraphics.kernels.numba.hash.cells import BLOCK, CHUNK, ZERO, ask_for, at_vertices, blend, locate, rows_of, spread
from invgraphics.kernels.numba.hash.jacobian import locate_back, rise, rise_back
from invgraphics.kernels.numba.runtime import array, index, inlined, once_differentiable, parallel, prange, share, threads
from invgraphics.kernels.numba.simd.instructions import blend_pair, spread_pair

UNIT, TWO = index(1), index(2)


@inlined
def _block(first, until):
    """The block that begins with a point: that point, and how many there are."""
    return index(first), min(BLOCK, until - first)


@inlined
def _gather(table, entries, weights, block, column, width, out):
    """Features of the points of a block; the usual two are read together."""
    first, count = block
    if width == TWO:
        for point in range(count):
            n = index(point)
            low, high = blend_pair(table, at_vertices(entries, n), at_vertices(weights, n))
            out[first + n, column] = low
            out[first + n, column + UNIT] = high
    else:
        for point in range(count):
            n = index(point)
            r, w = rows_of(at_vertices(entries, n), index(0), width), at_vertices(weights, n)
            for feature in range(width):
                out[first + n, column + index(feature)] = blend(table, r, w, index(feature))


@inlined
def _scatter(gradient, entries, weights, block, column, width, to_table):
    """The transpose of `_gather`."""
    first, count = block
    if width == TWO:
        for point in range(count):
            n = index(point)
            low, high = gradient[first + n, column], gradient[first + n, column + UNIT]
            spread_pair(to_table, at_vertices(entries, n), at_vertices(weights, n), low, high)
    else:
        for point in range(count):
            n = index(point)
            r, w = rows_of(at_vertices(entries, n), index(0), width), at_vertices(weights, n)
            for feature in range(width):
                spread(to_table, r, w, index(feature), gradient[first + n, column + index(feature)])


@parallel
def encode(planes, table, width, cells, offsets, masks, jobs, out):
    """Features of all levels at each point; ``table`` is flat."""
    x, y, z = planes[0], planes[1], planes[2]
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        begin, end = share(len(x), jobs, job), share(len(x), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            until = min(chunk + CHUNK, end)
            for number in range(len(cells)):
                level, column = (cells[number], offsets[number], masks[number]), index(number) * width
                for first in range(chunk, until + BLOCK, BLOCK):
                    # A block's entries are asked for before those of the block before it are read.
                    if first < until:
                        block, place = _block(first, until), first // BLOCK % 2
                        locate(x, y, z, block, level, entries[place], weights[place])
                        if width == TWO:
                            ask_for(table, entries[place], block[1])
                    if first > chunk:
                        block, place = _block(first - BLOCK, until), (first // BLOCK - 1) % 2
                        _gather(table, entries[place], weights[place], block, column, width, out)


@parallel
def encode_back(planes, gradient, width, cells, offsets, masks, jobs, to_table):
    """Gradient along the table. Each job owns every ``jobs``-th level, so no entry is written by two of them."""
    x, y, z = planes[0], planes[1], planes[2]
    for job in prange(jobs):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        for number in range(job, len(cells), jobs):
            level, column = (cells[number], offsets[number], masks[number]), index(number) * width
            to_table[index(offsets[number]) * width : index(offsets[number + 1]) * width] = ZERO
            for first in range(0, len(x), BLOCK):
                block = _block(first, len(x))
                locate(x, y, z, block, level, entries, weights)
                _scatter(gradient, entries, weights, block, column, width, to_table)


@cache
def levels_of(grid: HashGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells along an edge, first entries, and masks of the hash (0 where all vertices are stored) of every level."""
    cells = np.array(grid.resolutions, np.int64)
    hashed = (cells + 1) ** 3 > 2**grid.log2_size
    return cells, np.array(grid.offsets, np.int64), np.where(hashed, 2**grid.log2_size - 1, 0).astype(np.uint64)


def _planes(unit: Tensor) -> np.ndarray:
    """One array for each axis, which vector registers can be filled from."""
    return array(unit.T)


class _Encode(torch.autograd.Function):
    """Differentiable in positions and table."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
        width = table.shape[1]
        out = unit.new_empty(len(unit), grid.levels * width)
        encode(_planes(unit), array(table).reshape(-1), index(width), *levels_of(grid), threads(), out.numpy())
        ctx.save_for_backward(unit, table)
        ctx.grid = grid
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (gradient,) = grad_outputs
        unit, table = ctx.saved_tensors
        to_unit = _Slope.apply(unit, table, gradient, ctx.grid) if ctx.needs_input_grad[0] else None
        to_table = _Scatter.apply(unit, gradient, table.shape, ctx.grid) if ctx.needs_input_grad[1] else None
        return to_unit, to_table, None


class _Slope(torch.autograd.Function):
    """Gradient along the positions, itself differentiable in table and cotangent; in the positions it counts as constant."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, gradient: Tensor, grid: HashGrid) -> Tensor:
        ctx.save_for_backward(unit, table, gradient)
        ctx.grid, to_unit, width = grid, torch.empty(unit.shape), index(table.shape[1])
        flat = array(table).reshape(-1)
        locate_back(array(unit), flat, array(gradient), width, *levels_of(grid), threads(), to_unit.numpy())
        return to_unit

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, table, gradient = ctx.saved_tensors
        along = torch.where((unit >= 0) & (unit <= 1), grad_outputs[0], 0.0)
        points, direction, width, levels = array(unit), array(along), index(table.shape[1]), levels_of(ctx.grid)
        to_table = to_gradient = None
        if ctx.needs_input_grad[1]:
            to_table = torch.empty(table.shape)
            rise_back(points, array(gradient), direction, width, *levels, threads(), to_table.numpy().reshape(-1))
        if ctx.needs_input_grad[2]:
            to_gradient = torch.empty(gradient.shape)
            rise(points, array(table).reshape(-1), direction, width, *levels, threads(), to_gradient.numpy())
        return None, to_table, to_gradient, None


class _Scatter(torch.autograd.Function):
    """Gradient along the table; nothing needs its derivative, so it has none."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, gradient: Tensor, shape: torch.Size, grid: HashGrid) -> Tensor:
        to_table = torch.empty(shape)
        flat = to_table.numpy().reshape(-1)
        encode_back(_planes(unit), array(gradient), index(shape[1]), *levels_of(grid), threads(), flat)
        return to_table


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """See `invgraphics.kernels.hash_encode`; the Jacobian is left to the reference."""
    if jacobian:
        return reference.hash_encode(unit, table, grid, jacobian)
    return _Encode.apply(unit, table, grid), None
