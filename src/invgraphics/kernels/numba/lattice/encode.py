"""Lattice encoding: forward kernel and autograd (definition and judge: `invgraphics.kernels.reference.lattice`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.lattice import Combination, Lattice
from invgraphics.kernels import reference
from invgraphics.kernels.differentiation import once_differentiable, positions_only
from invgraphics.kernels.numba.lattice.backward import (
    TARGET,
    add_copies,
    feature_gradients,
    list_points,
    passes_over,
    split_rows,
)
from invgraphics.kernels.numba.lattice.cells import (
    BLOCK,
    corners_of,
    job_scratch,
    job_words,
    locate_block,
    padded,
    records,
    scratch_words,
)
from invgraphics.kernels.numba.lattice.pairs import is_pair, multiply_pair
from invgraphics.kernels.numba.lattice.positions import position_gradient
from invgraphics.kernels.numba.lattice.rows import interpolate_block
from invgraphics.kernels.numba.lattice.touched import sparse_rows, touched_rows
from invgraphics.kernels.numba.runtime import array, index, job_start, parallel, prange, scratch, threads
from invgraphics.kernels.numba.simd.partial import unowned

MOST_ROWS = 2**32 - 1
"""Vertices and rows that 32 bits can number, one number aside for empty vertices."""
LARGE = 32
"""Numbers in a lattice, per corner of the points' cells, above which gradients of the rows there cost less than whole ones."""
CORNERS_OF_TWO = (2, 0, 0)
"""Sizes of the forward pass's scratch: the corners of two lattices at a time."""


def memory_of(sizes: tuple[int, int, int], jobs: int) -> int:
    """Address of the scratch of all jobs, until the next call."""
    return scratch("lattice", jobs * job_words(sizes)).ctypes.data


@parallel
def encode(positions, lattices, memory, jobs, out):
    """Combined features of all lattices at each point; ``positions`` is (3, m), ``memory`` the address of the jobs' scratch."""
    points, width = positions.shape[1], index(out.shape[1])
    for job in prange(jobs):
        scratch, flat = job_scratch(memory, CORNERS_OF_TWO, job), unowned(out)
        (entries, weights), others, chosen = corners_of(scratch, 0), corners_of(scratch, 1), scratch[3]
        begin, end = job_start(points, jobs, job), job_start(points, jobs, job + 1)
        for start in range(begin, end, BLOCK):
            block = index(start), min(BLOCK, end - start)
            some = chosen, list_points(block[1], chosen)
            for number in range(len(lattices)):
                lattice = lattices[number]
                place = block[0] * width + index(lattice.column)
                if not is_pair(lattices, lattice.group, lattice.group_end):
                    locate_block(positions, block, lattice, entries, weights)
                    interpolate_block(lattice, entries, weights, some, lattice.mode, flat, place, width)
                elif number == lattice.group:
                    locate_block(positions, block, lattice, entries, weights)
                    locate_block(positions, block, lattices[number + 1], *others)
                    multiply_pair(lattice, lattices[number + 1], (entries, weights), others, some, flat, place, width)


@dataclass(frozen=True, eq=False)
class _Shape:
    """Lattices without their features, which autograd has to see as arguments."""

    lattices: tuple[Lattice, ...]
    combine: Combination
    sparse_gradients: bool

    def lattices_of(self, features: Sequence[Tensor]) -> list[Lattice]:
        """The lattices with these features."""
        return [replace(lattice, features=values) for lattice, values in zip(self.lattices, features, strict=True)]

    def records_of(self, features: Sequence[Tensor], combine: Combination | None = None) -> np.ndarray:
        return records(self.lattices_of([values.detach() for values in features]), combine or self.combine)


class _Encode(torch.autograd.Function):
    """Differentiable in positions and features, twice."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, shape: _Shape, *features: Tensor) -> Tensor:
        table = shape.records_of(features)
        out = unit.new_empty(len(unit), int((table["column"] + table["channels"]).max()))
        jobs = threads()
        encode(array(unit.T), table, memory_of(CORNERS_OF_TWO, jobs), jobs, out.numpy())
        ctx.save_for_backward(unit, *features)
        ctx.shape, ctx.positions_only = shape, positions_only()
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, *features = ctx.saved_tensors
        wanted = (ctx.needs_input_grad[0], *ctx.needs_input_grad[2:])
        if ctx.positions_only:
            unit, wanted = unit.detach(), (wanted[0], *(False for _ in features))
        if not any(wanted):
            return (None,) * len(ctx.needs_input_grad)
        # A gradient that is differentiated again is dense.
        shape = replace(ctx.shape, sparse_gradients=ctx.shape.sparse_gradients and not torch.is_grad_enabled())
        found = iter(_Gradient.apply(unit, grad_outputs[0], shape, wanted, *features))
        grad_unit, *grad_features = [next(found) if want else None for want in wanted]
        return grad_unit, None, *grad_features


class _Gradient(torch.autograd.Function):
    """Gradients of the positions and of all features, those that are wanted. Its own derivative is the reference's."""

    @staticmethod
    def forward(
        ctx: Any, unit: Tensor, gradient: Tensor, shape: _Shape, wanted: tuple[bool, ...], *features: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(unit, gradient, *features)
        ctx.shape, ctx.wanted = shape, wanted
        table, positions, received = shape.records_of(features), array(unit.T), array(gradient)
        found, sizes, jobs = [], scratch_words(table), threads()
        if wanted[0]:
            grad_unit = torch.empty(3, len(unit))
            position_gradient(positions, received, table, memory_of(sizes, jobs), sizes, jobs, grad_unit.numpy())
            found.append(grad_unit.T)
        if any(wanted[1:]):
            found += _gradients(positions, received, shape, features, wanted[1:])
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        needed = [ctx.needs_input_grad[0], ctx.needs_input_grad[1], *ctx.needs_input_grad[4:]]
        with torch.enable_grad():
            leaves = [saved.detach().requires_grad_() for saved in ctx.saved_tensors]
            unit, gradient, *features = leaves
            out = reference.lattice_encode(unit, ctx.shape.lattices_of(features), ctx.shape.combine)
            of = [leaf for leaf, want in zip((unit, *features), ctx.wanted, strict=True) if want]
            first = torch.autograd.grad(out, of, gradient, create_graph=True)
            asked = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
            found = iter(torch.autograd.grad(first, asked, grad_outputs, allow_unused=True))
        grad_unit, grad_gradient, *grad_features = [next(found) if need else None for need in needed]
        return grad_unit, grad_gradient, None, None, *grad_features


def _gradients(
    positions: np.ndarray, gradient: np.ndarray, shape: _Shape, features: Sequence[Tensor], wanted: Sequence[bool]
) -> list[Tensor]:
    """Gradients of the wanted features; where these may be sparse, those of large lattices are."""
    lattices = shape.lattices_of([values.detach() for values in features])
    sparse = shape.sparse_gradients and shape.combine in ("concat", "sum")
    chosen = {
        k: touched_rows(positions, lattice, f"lattice.slots {k}")
        for k, lattice in enumerate(lattices)
        if sparse and wanted[k] and _is_large(lattice, positions.shape[1])
    }
    written = [chosen[k][0] if k in chosen else lattice for k, lattice in enumerate(lattices)]
    out = [torch.empty(x.features.shape) if want else None for x, want in zip(written, wanted, strict=True)]
    _feature_gradients(positions, gradient, records(written, shape.combine), out)
    for k, (_, rows, unique) in chosen.items():
        values = out[k]
        assert values is not None
        out[k] = sparse_rows(lattices[k], rows, values, unique)
    return [tensor for tensor in out if tensor is not None]


def _is_large(lattice: Lattice, points: int) -> bool:
    """Whether a lattice has so many numbers that a gradient of the rows around so many points is cheaper than one of all."""
    return 0 < LARGE * 2 ** len(lattice.axes) * points < lattice.features.numel()


def _feature_gradients(positions: np.ndarray, gradient: np.ndarray, table: np.ndarray, out: Sequence[Tensor | None]) -> None:
    """Fill ``out``; lattices without a tensor there are left out."""
    jobs, targets, size = threads(), np.zeros(len(table), TARGET), 0
    for k, tensor in enumerate(out):
        rows, channels = int(table["rows"][k]), int(table["channels"][k])
        targets["gradient"][k], targets["copy"][k] = 0 if tensor is None else tensor.data_ptr(), -1
        # A copy is filled and added up once, which must cost less than what it saves at every point.
        if tensor is not None and (jobs == 1 or rows * jobs <= positions.shape[1]):
            targets["copy"][k], size = size, size + padded(rows * channels)
    copies, passes = (scratch("lattice.copies", size * (jobs - 1)).ctypes.data, 4 * size), passes_over(table, targets)
    starts = split_rows(positions, table, jobs if (passes["pivot"] >= 0).any() else 1)
    sizes = scratch_words(table)
    feature_gradients(positions, gradient, table, targets, passes, starts, copies, memory_of(sizes, jobs), sizes, jobs)
    if size and jobs > 1:
        add_copies(table, targets, copies, jobs)


def lattice_encode(
    unit: Float[Tensor, "m 3"],
    lattices: Sequence[Lattice],
    combine: Combination = "concat",
    sparse_gradients: bool = False,
) -> Float[Tensor, "m width"]:
    """See `invgraphics.kernels.lattice_encode`; the derivative of its gradient is the reference's."""
    if any(max(math.prod(lattice.resolution), len(lattice.rows)) >= MOST_ROWS for lattice in lattices):
        return reference.lattice_encode(unit, lattices, combine)
    shape = _Shape(tuple(_detached(lattice) for lattice in lattices), combine, sparse_gradients)
    return _Encode.apply(unit, shape, *(lattice.features.contiguous() for lattice in lattices))


def _detached(lattice: Lattice) -> Lattice:
    """The lattice without gradient, its links contiguous."""
    links = None if lattice.links is None else lattice.links.contiguous()
    return replace(lattice, features=lattice.features.detach(), links=links)
