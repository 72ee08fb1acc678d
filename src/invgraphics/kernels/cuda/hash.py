"""Multi-resolution hash encoding in Triton, forward and backward (definition: `invgraphics.kernels.reference.hash`).

A program encodes a block of points on one level, so that concurrent programs read the same level's entries.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import reference
from invgraphics.kernels.cuda.runtime import at_least_2, blocks, on_device_of
from invgraphics.kernels.differentiation import once_differentiable, positions_only
from invgraphics.kernels.reference.hash import PRIMES

BLOCK = 256
"""Points per program."""

_PRIME_Y, _PRIME_Z = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])


@triton.jit
def _axis(unit, point, axis: tl.constexpr, in_range, edge):
    """Lower vertex along one axis, the fraction beyond it, and 1 where the position was not clamped."""
    coordinate = tl.load(unit + 3 * point + axis, mask=in_range, other=0.0)
    inside = (coordinate >= 0.0) & (coordinate <= 1.0)
    position = tl.minimum(tl.maximum(coordinate, 0.0), 1.0) * edge.to(tl.float32)
    # The last vertex belongs to the last cell, so that it needs no neighbour beyond.
    lower = tl.minimum(position.to(tl.int32), edge - 1)
    return lower, position - lower.to(tl.float32), inside.to(tl.float32)


@triton.jit
def _entry(x, y, z, edge, mask):
    """Entry of a level's table that a vertex reads; ``mask`` is 0 on dense levels."""
    dense = x + (edge + 1) * (y + (edge + 1) * z)
    hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * _PRIME_Y) ^ (z.to(tl.uint32) * _PRIME_Z)
    return tl.where(mask == 0, dense, (hashed & mask.to(tl.uint32)).to(tl.int32))


@triton.jit(do_not_specialize=["points"])
def encode(unit, table, levels, out, points, count, FEATURES: tl.constexpr, WIDTH: tl.constexpr, SIZE: tl.constexpr):
    """Features of one level at a block of points. ``levels`` holds cells, offsets and masks, ``count`` of each."""
    level = tl.program_id(1)
    point = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    in_range, column = point < points, tl.arange(0, WIDTH)
    edge, offset, mask = tl.load(levels + level), tl.load(levels + count + level), tl.load(levels + 2 * count + level)
    x, fx, _ = _axis(unit, point, 0, in_range, edge)
    y, fy, _ = _axis(unit, point, 1, in_range, edge)
    z, fz, _ = _axis(unit, point, 2, in_range, edge)
    valid = in_range[:, None] & (column < FEATURES)[None, :]
    total = tl.zeros((SIZE, WIDTH), tl.float32)
    for corner in tl.static_range(8):
        i, j, k = corner % 2, corner // 2 % 2, corner // 4
        weight = (fx if i else 1.0 - fx) * (fy if j else 1.0 - fy) * (fz if k else 1.0 - fz)
        row = (offset + _entry(x + i, y + j, z + k, edge, mask)).to(tl.int64) * FEATURES
        total += weight[:, None] * tl.load(table + row[:, None] + column[None, :], mask=valid, other=0.0)
    tl.store(out + (point * count + level)[:, None] * FEATURES + column[None, :], total, mask=valid)


@triton.jit(do_not_specialize=["points"])
def encode_backward(
    unit, gradient, levels, grad_table, points, count, FEATURES: tl.constexpr, WIDTH: tl.constexpr, SIZE: tl.constexpr
):
    """Gradient of one level of the table, accumulated atomically over blocks of points."""
    level = tl.program_id(1)
    point = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    in_range, column = point < points, tl.arange(0, WIDTH)
    edge, offset, mask = tl.load(levels + level), tl.load(levels + count + level), tl.load(levels + 2 * count + level)
    x, fx, _ = _axis(unit, point, 0, in_range, edge)
    y, fy, _ = _axis(unit, point, 1, in_range, edge)
    z, fz, _ = _axis(unit, point, 2, in_range, edge)
    valid = in_range[:, None] & (column < FEATURES)[None, :]
    cotangent = tl.load(gradient + (point * count + level)[:, None] * FEATURES + column[None, :], mask=valid, other=0.0)
    for corner in tl.static_range(8):
        i, j, k = corner % 2, corner // 2 % 2, corner // 4
        weight = (fx if i else 1.0 - fx) * (fy if j else 1.0 - fy) * (fz if k else 1.0 - fz)
        row = (offset + _entry(x + i, y + j, z + k, edge, mask)).to(tl.int64) * FEATURES
        tl.atomic_add(grad_table + row[:, None] + column[None, :], weight[:, None] * cotangent, mask=valid)


@triton.jit(do_not_specialize=["points"])
def position_gradient(
    unit, table, gradient, levels, grad_unit, points, count, FEATURES: tl.constexpr, WIDTH: tl.constexpr, SIZE: tl.constexpr
):
    """Gradient of the positions, summed over levels; zero on axes on which a position was clamped."""
    point = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    in_range, column = point < points, tl.arange(0, WIDTH)
    valid = in_range[:, None] & (column < FEATURES)[None, :]
    along_x, along_y, along_z = tl.zeros((SIZE,), tl.float32), tl.zeros((SIZE,), tl.float32), tl.zeros((SIZE,), tl.float32)
    for level in range(count):
        edge, offset, mask = tl.load(levels + level), tl.load(levels + count + level), tl.load(levels + 2 * count + level)
        x, fx, in_x = _axis(unit, point, 0, in_range, edge)
        y, fy, in_y = _axis(unit, point, 1, in_range, edge)
        z, fz, in_z = _axis(unit, point, 2, in_range, edge)
        cotangent = tl.load(gradient + (point * count + level)[:, None] * FEATURES + column[None, :], mask=valid, other=0.0)
        for corner in tl.static_range(8):
            i, j, k = corner % 2, corner // 2 % 2, corner // 4
            wx, wy, wz = fx if i else 1.0 - fx, fy if j else 1.0 - fy, fz if k else 1.0 - fz
            row = (offset + _entry(x + i, y + j, z + k, edge, mask)).to(tl.int64) * FEATURES
            value = tl.load(table + row[:, None] + column[None, :], mask=valid, other=0.0)
            slope = tl.sum(value * cotangent, axis=1) * edge.to(tl.float32)
            along_x += slope * wy * wz * in_x * (2 * i - 1)
            along_y += slope * wx * wz * in_y * (2 * j - 1)
            along_z += slope * wx * wy * in_z * (2 * k - 1)
    tl.store(grad_unit + 3 * point, along_x, mask=in_range)
    tl.store(grad_unit + 3 * point + 1, along_y, mask=in_range)
    tl.store(grad_unit + 3 * point + 2, along_z, mask=in_range)


@cache
def _levels(grid: HashGrid, device: torch.device) -> Tensor:
    """Cells along an edge, first entries, and hash masks (0 on dense levels), concatenated."""
    masks = [2**grid.log2_size - 1 if (r + 1) ** 3 > 2**grid.log2_size else 0 for r in grid.resolutions]
    return torch.tensor([*grid.resolutions, *grid.offsets[:-1], *masks], dtype=torch.int32, device=device)


class _Encode(torch.autograd.Function):
    """Differentiable in positions and table, twice."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
        features, levels = table.shape[1], _levels(grid, table.device)
        out = table.new_empty(len(unit), grid.levels * features)
        if len(unit):
            sizes = (len(unit), grid.levels, features, at_least_2(features), BLOCK)
            with on_device_of(table):
                encode[(blocks(len(unit), BLOCK), grid.levels)](unit, table, levels, out, *sizes)
        ctx.save_for_backward(unit, table)
        ctx.grid, ctx.positions_only = grid, positions_only()
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, table = ctx.saved_tensors
        gradient = grad_outputs[0].contiguous()
        wants_table = ctx.needs_input_grad[1] and not ctx.positions_only
        grad_table = _TableGradient.apply(unit, gradient, table.shape, ctx.grid) if wants_table else None
        unit = unit.detach() if ctx.positions_only else unit
        grad_unit = _PositionGradient.apply(unit, table, gradient, ctx.grid) if ctx.needs_input_grad[0] else None
        return grad_unit, grad_table, None


class _PositionGradient(torch.autograd.Function):
    """Gradient of the positions; its own derivatives are left to the reference."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, table: Tensor, gradient: Tensor, grid: HashGrid) -> Tensor:
        ctx.save_for_backward(unit, table, gradient)
        ctx.grid, grad_unit, features = grid, torch.zeros_like(unit), table.shape[1]
        if len(unit):
            sizes = (len(unit), grid.levels, features, at_least_2(features), BLOCK)
            with on_device_of(table):
                position_gradient[(blocks(len(unit), BLOCK),)](
                    unit, table, gradient, _levels(grid, table.device), grad_unit, *sizes
                )
        return grad_unit

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        leaves = [x.detach().requires_grad_(needed) for x, needed in zip(ctx.saved_tensors, ctx.needs_input_grad, strict=False)]
        with torch.enable_grad():
            _, jacobian = reference.hash_encode(leaves[0], leaves[1], ctx.grid, jacobian=True)
            assert jacobian is not None
            grad_unit = torch.einsum("mfa,mf->ma", jacobian, leaves[2])
        wanted = [leaf for leaf in leaves if leaf.requires_grad]
        found = iter(torch.autograd.grad(grad_unit, wanted, grad_outputs[0], allow_unused=True))
        return *(next(found) if leaf.requires_grad else None for leaf in leaves), None


class _TableGradient(torch.autograd.Function):
    """Gradient of the table, linear in the cotangent; itself differentiable."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, gradient: Tensor, shape: torch.Size, grid: HashGrid) -> Tensor:
        grad_table, features = gradient.new_zeros(shape), shape[1]
        if len(unit):
            sizes = (len(unit), grid.levels, features, at_least_2(features), BLOCK)
            with on_device_of(gradient):
                along = blocks(len(unit), BLOCK)
                encode_backward[(along, grid.levels)](unit, gradient, _levels(grid, unit.device), grad_table, *sizes)
        ctx.save_for_backward(unit, gradient)
        ctx.grid = grid
        return grad_table

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        """A direction in the table times its gradient is the cotangent times the features of that direction."""
        along, (unit, gradient) = grad_outputs[0].contiguous(), ctx.saved_tensors
        grad_unit = _PositionGradient.apply(unit, along, gradient, ctx.grid) if ctx.needs_input_grad[0] else None
        grad_cotangent = _Encode.apply(unit, along, ctx.grid) if ctx.needs_input_grad[1] else None
        return grad_unit, grad_cotangent, None, None


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """See `invgraphics.kernels.hash_encode`; the Jacobian is left to the reference."""
    if jacobian:
        return reference.hash_encode(unit, table, grid, jacobian)
    # Contiguous before autograd sees them, lest what is differentiated again be copies outside the graph.
    return _Encode.apply(unit.contiguous(), table.contiguous(), grid), None
