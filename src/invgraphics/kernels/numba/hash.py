"""Multi-resolution hash encoding: positions and indices as in `invgraphics.kernels.reference.hash`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.numba.runtime import array, index, inlined, once_differentiable, parallel, prange, share, threads
from invgraphics.kernels.reference.hash import PRIMES
from invgraphics.kernels.types import HashGrid

CHUNK = 1024
"""Points that are taken through a level before the next one, so that the level's entries stay in the cache."""

_PRIME_Y, _PRIME_Z = np.uint64(PRIMES[1]), np.uint64(PRIMES[2])
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_UNIT = index(1)


@inlined
def axis(coordinate, cells):
    """Lower vertex along one axis and the fraction beyond it; in float64, as fine levels leave float32 few digits."""
    position = np.float64(coordinate) * np.float64(cells)
    position = position if position > 0.0 else 0.0
    position = min(position, np.float64(cells))
    # Through signed 32-bit integers: processors convert nothing else quickly. The last vertex belongs to the last cell.
    lower = max(min(np.int32(position), np.int32(cells - 1)), np.int32(0))
    return np.uint64(lower), np.float32(position - np.float64(lower))


@inlined
def corners(point, cells, mask):
    """Entries of the 8 vertices around a position (x fastest), and the fractions; ``mask`` is 0 on dense levels."""
    x, fx = axis(point[0], cells)
    y, fy = axis(point[1], cells)
    z, fz = axis(point[2], cells)
    if mask == 0:
        edge = np.uint64(cells + 1)
        a = x + edge * (y + edge * z)
        b, c = a + edge, a + edge * edge
        d = b + edge * edge
        entries = (a, a + _UNIT, b, b + _UNIT, c, c + _UNIT, d, d + _UNIT)
    else:
        y0, z0 = y * _PRIME_Y, z * _PRIME_Z
        y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        u = x + _UNIT
        entries = (
            (x ^ a) & mask, (u ^ a) & mask, (x ^ b) & mask, (u ^ b) & mask,
            (x ^ c) & mask, (u ^ c) & mask, (x ^ d) & mask, (u ^ d) & mask,
        )  # fmt: skip
    return entries, (fx, fy, fz)


@inlined
def rows_of(e, offset, width):
    """Where the entries' features begin in the flat table."""
    return (
        (offset + e[0]) * width, (offset + e[1]) * width, (offset + e[2]) * width, (offset + e[3]) * width,
        (offset + e[4]) * width, (offset + e[5]) * width, (offset + e[6]) * width, (offset + e[7]) * width,
    )  # fmt: skip


@inlined
def weights_of(f):
    """Trilinear weights of the 8 vertices (x fastest)."""
    x, y, z = f
    p, q = _ONE - x, _ONE - y
    low, high = _ONE - z, z
    a, b, c, d = q * low, y * low, q * high, y * high
    return p * a, x * a, p * b, x * b, p * c, x * c, p * d, x * d


@inlined
def _blend(table, r, w, k):
    """Weighted sum of the vertices' k-th features."""
    low = w[0] * table[r[0] + k] + w[1] * table[r[1] + k] + w[2] * table[r[2] + k] + w[3] * table[r[3] + k]
    return low + w[4] * table[r[4] + k] + w[5] * table[r[5] + k] + w[6] * table[r[6] + k] + w[7] * table[r[7] + k]


@inlined
def _spread(to_table, r, w, k, g):
    """Add a gradient to the vertices' k-th features."""
    to_table[r[0] + k] += w[0] * g
    to_table[r[1] + k] += w[1] * g
    to_table[r[2] + k] += w[2] * g
    to_table[r[3] + k] += w[3] * g
    to_table[r[4] + k] += w[4] * g
    to_table[r[5] + k] += w[5] * g
    to_table[r[6] + k] += w[6] * g
    to_table[r[7] + k] += w[7] * g


@parallel
def encode(unit, table, width, cells, offsets, masks, jobs, out):
    """Features of all levels at each point; ``table`` is flat. Features go in pairs, which keeps the usual two unrolled."""
    for job in prange(jobs):
        begin, end = share(len(unit), jobs, job), share(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                column = index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = corners(unit[i], edge, mask)
                    w, r = weights_of(f), rows_of(entries, offset, width)
                    for pair in range(width >> _UNIT):
                        k = index(pair + pair)
                        out[i, column + k] = _blend(table, r, w, k)
                        out[i, column + k + _UNIT] = _blend(table, r, w, k + _UNIT)
                    if width & _UNIT:
                        out[i, column + width - _UNIT] = _blend(table, r, w, width - _UNIT)


@parallel
def encode_back(unit, gradient, width, cells, offsets, masks, jobs, to_table):
    """Gradient along the table. Each job owns every ``jobs``-th level, so no entry is written by two of them."""
    for job in prange(jobs):
        for level in range(job, len(cells), jobs):
            offset, mask, edge = index(offsets[level]), masks[level], cells[level]
            column = index(level) * width
            to_table[offset * width : index(offsets[level + 1]) * width] = _ZERO
            for number in range(len(unit)):
                i = index(number)
                entries, f = corners(unit[i], edge, mask)
                w, r = weights_of(f), rows_of(entries, offset, width)
                for pair in range(width >> _UNIT):
                    k = index(pair + pair)
                    _spread(to_table, r, w, k, gradient[i, column + k])
                    _spread(to_table, r, w, k + _UNIT, gradient[i, column + k + _UNIT])
                if width & _UNIT:
                    _spread(to_table, r, w, width - _UNIT, gradient[i, column + width - _UNIT])


@inlined
def slopes(v, f):
    """Derivatives along the fractions of the trilinear interpolant of the 8 values ``v``."""
    x, y, z = f
    p, q, r = _ONE - x, _ONE - y, _ONE - z
    along_x = q * r * (v[1] - v[0]) + y * r * (v[3] - v[2]) + q * z * (v[5] - v[4]) + y * z * (v[7] - v[6])
    along_y = p * r * (v[2] - v[0]) + x * r * (v[3] - v[1]) + p * z * (v[6] - v[4]) + x * z * (v[7] - v[5])
    along_z = p * q * (v[4] - v[0]) + x * q * (v[5] - v[1]) + p * y * (v[6] - v[2]) + x * y * (v[7] - v[3])
    return along_x, along_y, along_z


@inlined
def _vertex_values(table, r, k):
    return (
        table[r[0] + k], table[r[1] + k], table[r[2] + k], table[r[3] + k],
        table[r[4] + k], table[r[5] + k], table[r[6] + k], table[r[7] + k],
    )  # fmt: skip


@parallel
def locate_back(unit, table, gradient, width, cells, offsets, masks, jobs, to_unit):
    """Gradient along the positions; zero along the axes on which a position was clamped."""
    for job in prange(jobs):
        begin, end = share(len(unit), jobs, job), share(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            to_unit[chunk : min(chunk + CHUNK, end)] = _ZERO
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                scale, column = np.float32(edge), index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = corners(unit[i], edge, mask)
                    r = rows_of(entries, offset, width)
                    for feature in range(width):
                        k = index(feature)
                        x, y, z = slopes(_vertex_values(table, r, k), f)
                        g = gradient[i, column + k] * scale
                        to_unit[i, 0] += g * x
                        to_unit[i, 1] += g * y
                        to_unit[i, 2] += g * z
            for number in range(chunk, min(chunk + CHUNK, end)):
                for a in range(3):
                    coordinate = unit[number, a]
                    if not (coordinate >= _ZERO and coordinate <= _ONE):
                        to_unit[number, a] = _ZERO


@cache
def _levels(grid: HashGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells along an edge, first entries, and masks of the hash (0 where all vertices are stored) of every level."""
    cells = np.array(grid.resolutions, np.int64)
    hashed = (cells + 1) ** 3 > 2**grid.log2_size
    return cells, np.array(grid.offsets, np.int64), np.where(hashed, 2**grid.log2_size - 1, 0).astype(np.uint64)


class _Encode(torch.autograd.Function):
    """Differentiable in positions and table."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
        width = table.shape[1]
        out = unit.new_empty(len(unit), grid.levels * width)
        encode(array(unit), array(table).reshape(-1), index(width), *_levels(grid), threads(), out.numpy())
        ctx.save_for_backward(unit, table)
        ctx.grid = grid
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (gradient,) = grad_outputs
        unit, table = ctx.saved_tensors
        points, received, width = array(unit), array(gradient), index(table.shape[1])
        levels, jobs = _levels(ctx.grid), threads()
        to_unit = to_table = None
        if ctx.needs_input_grad[0]:
            to_unit = torch.empty(unit.shape)
            locate_back(points, array(table).reshape(-1), received, width, *levels, jobs, to_unit.numpy())
        if ctx.needs_input_grad[1]:
            to_table = torch.empty(table.shape)
            encode_back(points, received, width, *levels, jobs, to_table.numpy().reshape(-1))
        return to_unit, to_table, None


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """See `invgraphics.kernels.hash_encode`; the Jacobian is left to the reference."""
    if jacobian:
        return reference.hash_encode(unit, table, grid, jacobian)
    return _Encode.apply(unit, table, grid), None
