"""Weighted sums of consecutive rows, forward and backward. Each job owns whole segments, so every sum has a fixed order."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.runtime import array, index, inlined, job_start, parallel, prange, threads


@inlined
def first_of_segment(segment, jobs, job):
    """First row of a job: an even split, moved on to the beginning of a segment."""
    first = job_start(len(segment), jobs, job)
    while 0 < first < len(segment) and segment[first] == segment[first - 1]:
        first += 1
    return first


@parallel
def sum_rows(values, weights, segment, jobs, sums):
    """Add every row times its weight to its segment's sum (``sums`` holds zeros before)."""
    width = values.shape[1]
    for job in prange(jobs):
        for number in range(first_of_segment(segment, jobs, job), first_of_segment(segment, jobs, job + 1)):
            i = index(number)
            s, weight = index(segment[i]), weights[i]
            for k in range(width):
                sums[s, index(k)] += weight * values[i, index(k)]


@parallel
def sum_rows_backward(values, weights, segment, jobs, grad_sums, grad_values, grad_weights):
    """Gradients of rows and weights."""
    rows, width = values.shape
    for job in prange(jobs):
        for number in range(job_start(rows, jobs, job), job_start(rows, jobs, job + 1)):
            i = index(number)
            s, weight = index(segment[i]), weights[i]
            grad_weight = np.float32(0.0)
            for k in range(width):
                gradient = grad_sums[s, index(k)]
                grad_weight += gradient * values[i, index(k)]
                grad_values[i, index(k)] = weight * gradient
            grad_weights[i] = grad_weight


class _SegmentSums(torch.autograd.Function):
    """Differentiable in values and weights."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, weights: Tensor, segment: Tensor, segments: int) -> Tensor:
        sums = torch.zeros(segments, values.shape[1])
        sum_rows(array(values), array(weights), array(segment.long()), threads(), sums.numpy())
        ctx.save_for_backward(values, weights, segment)
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        values, weights, segment = ctx.saved_tensors
        grad_values, grad_weights = torch.empty(values.shape), torch.empty(weights.shape)
        kept = array(values), array(weights), array(segment.long())
        sum_rows_backward(*kept, threads(), array(grad_outputs[0]), grad_values.numpy(), grad_weights.numpy())
        return grad_values, grad_weights, None, None


def segment_sums(
    values: Float[Tensor, "r f"], weights: Float[Tensor, " r"], segment: Int[Tensor, " r"], segments: int
) -> Float[Tensor, "n f"]:
    """See `invgraphics.kernels.segments.segment_sums`."""
    if len(segment) and not 0 <= int(segment[0]) <= int(segment[-1]) < segments:
        raise IndexError(f"Rows belong to segments {int(segment[0])} to {int(segment[-1])}, but there are {segments}.")
    return _SegmentSums.apply(values, weights, segment, segments)
