"""Adam on the entries that a step touched (definition and judge: `invgraphics.kernels.reference.adam`)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.numba.runtime import GROUP as REGISTER
from invgraphics.kernels.numba.runtime import array, index, inlined, job_start, parallel, prange, threads
from invgraphics.kernels.numba.simd.lanes import load, store, where
from invgraphics.kernels.numba.simd.partial import load_first, store_first
from invgraphics.kernels.types import AdamStep

GROUP = 64
"""Entries of a gradient that are tested together: four cache lines, so that skipped ones cost one read."""
ZERO, ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _any_touched(gradient, first, end):
    """Whether an entry is not 0; NaN is not. A sum, because LLVM vectorises it."""
    total = ZERO
    for number in range(first, end):
        total += abs(gradient[index(number)])
    return total != ZERO


@inlined
def _stepped(found, factor, numbers, skip):
    """Values and moments after a step, of values, gradient and moments before it."""
    value, g, m, v = found
    beta1, beta2, rest1, rest2, eps = numbers
    new_m, new_v = beta1 * m + rest1 * g, beta2 * v + rest2 * g * g
    # Not where the gradient is NaN: comparisons with it are false.
    untouched = abs(g) <= (ZERO if skip else -ONE)
    step = factor * new_m / (np.sqrt(new_v) + eps)
    return where(untouched, value, value - step), where(untouched, m, new_m), where(untouched, v, new_v)


@inlined
def _update(arrays, first, end, source, factor, numbers, skip):
    """Step of consecutive entries, whose gradients begin at ``source``; ``numbers``: decays, their complements and eps."""
    values, gradient, mean, square = arrays
    whole, ahead = first + (end - first) // REGISTER * REGISTER, source - first
    for start in range(first, whole, REGISTER):
        i = index(start)
        found = load(values, i), load(gradient, index(start + ahead)), load(mean, i), load(square, i)
        value, m, v = _stepped(found, factor, numbers, skip)
        store(values, i, value)
        store(mean, i, m)
        store(square, i, v)
    if whole < end:
        i, part = index(whole), index(end - whole)
        found = (
            load_first(values, i, part),
            load_first(gradient, index(whole + ahead), part),
            load_first(mean, i, part),
            load_first(square, i, part),
        )
        value, m, v = _stepped(found, factor, numbers, skip)
        store_first(values, i, part, value)
        store_first(mean, i, part, m)
        store_first(square, i, part, v)


@parallel
def adam(arrays, rates, rows, width, size, numbers, skip, jobs):
    """One step of flat ``arrays``: values, gradient and moments, rows of ``width``; ``rates`` per row, or empty.

    ``rows`` are those that the gradient has; empty for all.
    """
    gradient = arrays[1]
    count = len(gradient) // width
    for job in prange(jobs):
        if len(rates) > 0 or len(rows) > 0:
            for number in range(job_start(count, jobs, job), job_start(count, jobs, job + 1)):
                row = rows[index(number)] if len(rows) > 0 else np.int64(number)
                rate = rates[index(row)] if len(rates) > 0 else ONE
                source = number * width
                if not skip or _any_touched(gradient, source, source + width):
                    _update(arrays, row * width, (row + 1) * width, source, size * rate, numbers, skip)
        else:
            until = job_start(count, jobs, job + 1) * width
            for first in range(job_start(count, jobs, job) * width, until, GROUP):
                end = min(first + GROUP, until)
                if not skip or _any_touched(gradient, first, end):
                    _update(arrays, first, end, first, size, numbers, skip)


def adam_rows(
    values: Float[Tensor, "*rows c"],
    gradient: Float[Tensor, "*rows c"] | Float[Tensor, "k c"],
    moments: tuple[Float[Tensor, "*rows c"], Float[Tensor, "*rows c"]],
    step: AdamStep,
    rates: Float[Tensor, "*rows"] | None = None,
    rows: Int[Tensor, " k"] | None = None,
) -> None:
    """See `invgraphics.kernels.adam_rows`; tensors that are not contiguous are left to the reference."""
    if not all(tensor.is_contiguous() for tensor in (values, *moments)) or gradient.numel() == 0:
        return reference.adam_rows(values, gradient, moments, step, rates, rows)
    arrays = tuple(array(tensor).reshape(-1) for tensor in (values, gradient, *moments))
    numbers = tuple(np.float32(x) for x in (step.beta1, step.beta2, 1 - step.beta1, 1 - step.beta2, step.eps))
    each = np.empty(0, np.float32) if rates is None else array(rates.to(torch.float32)).reshape(-1)
    some = np.empty(0, np.int64) if rows is None else array(rows)
    adam(arrays, each, some, values.shape[-1], np.float32(step.size), numbers, step.skip_zero, threads())
