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
from invgraphics.kernels.numba.lattice.backward import factor_gradients, feature_gradients, position_gradient, split_rows
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, encode_block, records
from invgraphics.kernels.numba.runtime import array, index, job_start, once_differentiable, parallel, prange, scratch, threads

MOST_ROWS = 2**32 - 1
"""Vertices and rows that 32 bits can number, one number aside for empty vertices."""


@parallel
def encode(positions, lattices, jobs, out):
    """Combined features of all lattices at each point; ``positions`` is (3, m)."""
    points = positions.shape[1]
    for job in prange(jobs):
        entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
        begin, end = job_start(points, jobs, job), job_start(points, jobs, job + 1)
        for first in range(begin, end, BLOCK):
            block = index(first), min(BLOCK, end - first)
            for number in range(len(lattices)):
                encode_block(positions, block, lattices[number], entries, weights, out, block[0])


@dataclass(frozen=True, eq=False)
class _Shape:
    """Lattices without their features, which autograd has to see as arguments."""

    lattices: tuple[Lattice, ...]
    combine: Combination

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
        encode(array(unit.T), table, threads(), out.numpy())
        ctx.save_for_backward(unit, *features)
        ctx.shape = shape
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        unit, *features = ctx.saved_tensors
        wanted = (ctx.needs_input_grad[0], *ctx.needs_input_grad[2:])
        found = iter(_Gradient.apply(unit, grad_outputs[0], ctx.shape, wanted, *features))
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
        if shape.combine in ("vm", "cp"):
            separate = shape.records_of(features, "concat")
            total = int(separate["channels"].sum())
            products = scratch("lattice.factors", len(unit) * total).reshape(len(unit), total)
            separate["group"], separate["group_end"] = table["group"], table["group_end"]
            factor_gradients(positions, received, table, separate, threads(), products)
            table, received = separate, products
        found = []
        if wanted[0]:
            grad_unit = torch.empty(3, len(unit))
            position_gradient(positions, received, table, threads(), grad_unit.numpy())
            found.append(grad_unit.T)
        chosen = np.array(wanted[1:])
        if chosen.any():
            grad_features = [torch.empty(values.shape) for values, want in zip(features, chosen, strict=True) if want]
            addresses = np.array([values.data_ptr() for values in grad_features], np.int64)
            jobs, table = threads(), table[chosen]
            feature_gradients(positions, received, table, split_rows(positions, table, jobs), addresses, jobs)
            found += grad_features
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


def lattice_encode(
    unit: Float[Tensor, "m 3"], lattices: Sequence[Lattice], combine: Combination = "concat"
) -> Float[Tensor, "m width"]:
    """See `invgraphics.kernels.lattice_encode`; the derivative of its gradient is the reference's."""
    if any(max(math.prod(lattice.resolution), len(lattice.rows)) >= MOST_ROWS for lattice in lattices):
        return reference.lattice_encode(unit, lattices, combine)
    shape = _Shape(tuple(_detached(lattice) for lattice in lattices), combine)
    return _Encode.apply(unit, shape, *(lattice.features.contiguous() for lattice in lattices))


def _detached(lattice: Lattice) -> Lattice:
    """The lattice without gradient, its links contiguous."""
    links = None if lattice.links is None else lattice.links.contiguous()
    return replace(lattice, features=lattice.features.detach(), links=links)
