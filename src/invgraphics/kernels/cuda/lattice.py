"""Interpolation on lattices in Triton, forward and backward (definition: `invgraphics.kernels.reference.lattice`).

A program interpolates a block of points and all channels of one lattice. Second derivatives are left to the reference.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.lattice import Combination, Lattice
from invgraphics.kernels.cuda.runtime import at_least_2, blocks, on_device_of
from invgraphics.kernels.differentiation import positions_only
from invgraphics.kernels.reference.lattice import combine_features, interpolate

BLOCK = 64
"""Points per program."""


@triton.jit
def _along(unit, point, column, in_range, count):
    """Vertices around the points on one axis of ``count`` vertices, the fraction between them, and its derivative."""
    given = tl.load(unit + 3 * point + column, mask=in_range, other=0.0)
    known = tl.where(given != given, 0.0, given)  # noqa: PLR0124  # NaN counts as 0
    cells = count - 1
    position = tl.minimum(tl.maximum(known, 0.0), 1.0) * cells
    # The last vertex belongs to the last cell, so that it needs no neighbour beyond.
    lower = tl.minimum(position.to(tl.int32), tl.maximum(cells - 1, 0))
    slope = tl.where((given >= 0) & (given <= 1), cells.to(tl.float32), 0.0)
    return lower, tl.minimum(lower + 1, cells), position - lower.to(tl.float32), slope


@triton.jit
def _places(unit, point, in_range, columns, counts, AXES: tl.constexpr):
    """`_along` of up to three axes; those that the lattice does not span have one vertex."""
    lx, ux, fx, sx = _along(unit, point, tl.load(columns), in_range, tl.load(counts))
    ly, uy, fy, sy = tl.zeros_like(lx), tl.zeros_like(lx), tl.zeros_like(fx), tl.zeros_like(fx)
    lz, uz, fz, sz = tl.zeros_like(lx), tl.zeros_like(lx), tl.zeros_like(fx), tl.zeros_like(fx)
    if AXES > 1:
        ly, uy, fy, sy = _along(unit, point, tl.load(columns + 1), in_range, tl.load(counts + 1))
    if AXES > 2:
        lz, uz, fz, sz = _along(unit, point, tl.load(columns + 2), in_range, tl.load(counts + 2))
    return lx, ux, fx, sx, ly, uy, fy, sy, lz, uz, fz, sz


@triton.jit
def _row(x, y, z, links, counts, rows, in_range, LINKED: tl.constexpr):
    """Row of features of each vertex, and whether it has one."""
    index = (x.to(tl.int64) * tl.load(counts + 1) + y) * tl.load(counts + 2) + z
    there = in_range
    if LINKED:
        index = tl.load(links + index, mask=in_range, other=-1).to(tl.int64)
        there = in_range & (index >= 0) & (index < rows)
        index = tl.where(there, index, 0)
    return index, there


@triton.jit(do_not_specialize=["points", "rows"])
def encode(
    unit, features, links, columns, counts, out, points, rows, channels,
    AXES: tl.constexpr, LINKED: tl.constexpr, WIDTH: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Features at a block of points."""
    point = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    in_range, channel = point < points, tl.arange(0, WIDTH)
    lx, ux, fx, _, ly, uy, fy, _, lz, uz, fz, _ = _places(unit, point, in_range, columns, counts, AXES)
    total = tl.zeros((SIZE, WIDTH), tl.float32)
    for corner in tl.static_range(1 << AXES):
        i, j, k = corner % 2, corner // 2 % 2, corner // 4
        weight = (fx if i else 1.0 - fx) * (fy if j else 1.0 - fy) * (fz if k else 1.0 - fz)
        row, there = _row(ux if i else lx, uy if j else ly, uz if k else lz, links, counts, rows, in_range, LINKED)
        valid = there[:, None] & (channel < channels)[None, :]
        total += weight[:, None] * tl.load(features + row[:, None] * channels + channel[None, :], mask=valid, other=0.0)
    tl.store(out + point[:, None] * channels + channel[None, :], total, mask=in_range[:, None] & (channel < channels)[None, :])


@triton.jit(do_not_specialize=["points", "rows"])
def encode_backward(
    unit, features, links, columns, counts, gradient, grad_unit, grad_features, points, rows, channels,
    AXES: tl.constexpr, LINKED: tl.constexpr, POSITIONS: tl.constexpr, WIDTH: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Gradients of the features, added atomically, and if ``POSITIONS`` those of the block's points."""
    point = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    in_range, channel = point < points, tl.arange(0, WIDTH)
    lx, ux, fx, sx, ly, uy, fy, sy, lz, uz, fz, sz = _places(unit, point, in_range, columns, counts, AXES)
    known = in_range[:, None] & (channel < channels)[None, :]
    cotangent = tl.load(gradient + point[:, None] * channels + channel[None, :], mask=known, other=0.0)
    along_x, along_y, along_z = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(1 << AXES):
        i, j, k = corner % 2, corner // 2 % 2, corner // 4
        wx, wy, wz = fx if i else 1.0 - fx, fy if j else 1.0 - fy, fz if k else 1.0 - fz
        row, there = _row(ux if i else lx, uy if j else ly, uz if k else lz, links, counts, rows, in_range, LINKED)
        valid = there[:, None] & (channel < channels)[None, :]
        place = row[:, None] * channels + channel[None, :]
        tl.atomic_add(grad_features + place, (wx * wy * wz)[:, None] * cotangent, mask=valid)
        if POSITIONS:
            share = tl.sum(tl.load(features + place, mask=valid, other=0.0) * cotangent, axis=1)
            along_x += share * wy * wz * (2 * i - 1)
            along_y += share * wx * wz * (2 * j - 1)
            along_z += share * wx * wy * (2 * k - 1)
    if POSITIONS:
        tl.store(grad_unit + 3 * point + tl.load(columns), along_x * sx, mask=in_range)
        if AXES > 1:
            tl.store(grad_unit + 3 * point + tl.load(columns + 1), along_y * sy, mask=in_range)
        if AXES > 2:
            tl.store(grad_unit + 3 * point + tl.load(columns + 2), along_z * sz, mask=in_range)


class _Interpolate(torch.autograd.Function):
    """Differentiable in positions and features, and where that is wanted once more by the reference."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, features: Tensor, lattice: Lattice) -> Tensor:
        rows, axes, channels = features.reshape(-1, lattice.channels), len(lattice.axes), lattice.channels
        numbers = [*lattice.columns, *[0] * (3 - axes), *lattice.resolution, *[1] * (3 - axes)]
        shape = torch.tensor(numbers, dtype=torch.int32).to(unit.device, non_blocking=True)
        links = shape if lattice.links is None else lattice.links.contiguous()
        ctx.sizes = len(unit), len(rows), channels
        ctx.flags = {"AXES": axes, "LINKED": lattice.links is not None, "WIDTH": at_least_2(channels), "SIZE": BLOCK}
        ctx.lattice, ctx.positions_only = lattice, positions_only()
        out = unit.new_empty(len(unit), channels)
        if len(unit):
            with on_device_of(unit):
                encode[(blocks(len(unit), BLOCK),)](unit, rows, links, shape, shape[3:], out, *ctx.sizes, **ctx.flags)
        ctx.save_for_backward(unit, features, links, shape)
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, features, links, shape = ctx.saved_tensors
        if torch.is_grad_enabled():  # a second derivative may follow
            lattice = replace(ctx.lattice, features=features)
            needs = (ctx.needs_input_grad[0], ctx.needs_input_grad[1] and not ctx.positions_only)
            wanted = [x for x, needed in zip((unit, features), needs, strict=True) if needed]
            if not wanted:
                return None, None, None
            gradients = iter(torch.autograd.grad(interpolate(unit, lattice), wanted, grad_outputs[0], create_graph=True))
            return *(next(gradients) if needed else None for needed in needs), None
        gradient, grad_unit, grad_features = grad_outputs[0].contiguous(), torch.zeros_like(unit), torch.zeros_like(features)
        flags = {"POSITIONS": ctx.needs_input_grad[0], **ctx.flags}
        if len(unit):
            results = gradient, grad_unit, grad_features
            with on_device_of(unit):
                inputs = unit, features, links, shape, shape[3:]
                encode_backward[(blocks(len(unit), BLOCK),)](*inputs, *results, *ctx.sizes, **flags)
        return grad_unit if ctx.needs_input_grad[0] else None, grad_features, None


def lattice_encode(
    unit: Float[Tensor, "m 3"],
    lattices: Sequence[Lattice],
    combine: Combination = "concat",
    sparse_gradients: bool = False,
) -> Float[Tensor, "m width"]:
    """See `invgraphics.kernels.lattice_encode`; gradients are dense, and the derivative of the gradient is the reference's."""
    bare = (replace(lattice, features=lattice.features.detach()) for lattice in lattices)
    # Contiguous before autograd sees them, lest what is differentiated again be copies outside the graph.
    unit, features = unit.contiguous(), [lattice.features.contiguous() for lattice in lattices]
    values = [_Interpolate.apply(unit, rows, lattice) for rows, lattice in zip(features, bare, strict=True)]
    return combine_features(values, combine)
