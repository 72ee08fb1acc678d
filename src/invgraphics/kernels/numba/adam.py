"""Adam on the entries that a step touched (definition and judge: `invgraphics.kernels.reference.adam`)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
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
def _update(arrays, first, end, factor, numbers, skip):
    """Step of consecutive entries; ``numbers`` are the decays, their complements and eps."""
    values, gradient, mean, square = arrays
    whole = first + (end - first) // REGISTER * REGISTER
    for start in range(first, whole, REGISTER):
        i = index(start)
        found = load(values, i), load(gradient, i), load(mean, i), load(square, i)
        value, m, v = _stepped(found, factor, numbers, skip)
        store(values, i, value)
        store(mean, i, m)
        store(square, i, v)
    if whole < end:
        i, part = index(whole), index(end - whole)
        found = (
            load_first(values, i, part),
            load_first(gradient, i, part),
            load_first(mean, i, part),
            load_first(square, i, part),
        )
        value, m, v = _stepped(found, factor, numbers, skip)
        store_first(values, i, part, value)
        store_first(mean, i, part, m)
        store_first(square, i, part, v)


@parallel
def adam(arrays, rates, width, size, numbers, skip, jobs):
    """One step of flat ``arrays``: values, gradient and moments, rows of ``width``; ``rates`` per row, or empty."""
    gradient = arrays[1]
    rows = len(gradient) // width
    for job in prange(jobs):
        if len(rates) > 0:
            for row in range(job_start(rows, jobs, job), job_start(rows, jobs, job + 1)):
                first, end = row * width, (row + 1) * width
                if not skip or _any_touched(gradient, first, end):
                    _update(arrays, first, end, size * rates[index(row)], numbers, skip)
        else:
            until = job_start(rows, jobs, job + 1) * width
            for first in range(job_start(rows, jobs, job) * width, until, GROUP):
                end = min(first + GROUP, until)
                if not skip or _any_touched(gradient, first, end):
                    _update(arrays, first, end, size, numbers, skip)


def adam_rows(
    values: Float[Tensor, "*rows c"],
    gradient: Float[Tensor, "*rows c"],
    moments: tuple[Float[Tensor, "*rows c"], Float[Tensor, "*rows c"]],
    step: AdamStep,
    rates: Float[Tensor, "*rows"] | None = None,
) -> None:
    """See `invgraphics.kernels.adam_rows`; tensors that are not contiguous are left to the reference."""
    if not all(tensor.is_contiguous() for tensor in (values, *moments)) or values.numel() == 0:
        return reference.adam_rows(values, gradient, moments, step, rates)
    arrays = tuple(array(tensor).reshape(-1) for tensor in (values, gradient, *moments))
    numbers = tuple(np.float32(x) for x in (step.beta1, step.beta2, 1 - step.beta1, 1 - step.beta2, step.eps))
    each = np.empty(0, np.float32) if rates is None else array(rates.to(torch.float32)).reshape(-1)
    adam(arrays, each, values.shape[-1], np.float32(step.size), numbers, step.skip_zero, threads())
