"""Weights along rays as step functions: dilation, blur, and resampling in intervals (mip-NeRF 360, §3 and supplement)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from invgraphics.core import Context
from invgraphics.renderers.samplers import quantiles, sample_pdf


def blur(weights: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Mean of each weight's larger neighbours on either side, itself included (mip-NeRF, equation 18)."""
    padded = torch.cat([weights[:, :1], weights, weights[:, -1:]], dim=1)
    larger = torch.maximum(padded[:, 1:], padded[:, :-1])
    return (larger[:, 1:] + larger[:, :-1]) / 2


def dilate(
    edges: Float[Tensor, "k edges"], weights: Float[Tensor, "k bins"], by: float
) -> tuple[Float[Tensor, "k wide"], Float[Tensor, "k wider_bins"]]:
    """Largest density within ``by`` of each place, as weights of new intervals (mip-NeRF 360, supplement).

    Every interval is widened by ``by`` on both sides, between the first and last edge; each point takes the largest density of
    the intervals that reach it. Weights keep their sum.

    Args:
        edges: of adjoining intervals, increasing along each row.
        weights: of these intervals.
        by: widening, >= 0.
    """
    tiny = torch.finfo(edges.dtype).tiny
    lower, upper = edges[:, :-1].contiguous(), edges[:, 1:].contiguous()
    density = weights / (upper - lower).clamp_min(tiny)
    lo, hi = edges[:, :1], edges[:, -1:]
    wide = torch.cat([edges, lower - by, upper + by], dim=1).clamp(lo, hi).sort(dim=1).values
    # Evaluated in the middle of each new interval, within which no interval's reach begins or ends.
    middle = ((wide[:, 1:] + wide[:, :-1]) / 2).contiguous()
    first = torch.searchsorted(upper + by, middle, right=True).clamp_max(lower.shape[1] - 1)
    last = (torch.searchsorted(lower - by, middle, right=True) - 1).clamp_min(0)
    widened = range_max(density, first, torch.maximum(first, last)) * wide.diff(dim=1)
    total = widened.sum(dim=1, keepdim=True).clamp_min(tiny)
    return wide, widened * (weights.sum(dim=1, keepdim=True) / total)


def range_max(values: Float[Tensor, "k n"], first: Tensor, last: Tensor) -> Float[Tensor, "k m"]:
    """Largest of ``values[first .. last]`` in each row, by maxima over powers of two (a sparse table).

    Args:
        values: rows of n numbers.
        first: index of the first, (k, m).
        last: index of the last, >= ``first``, (k, m).
    """
    count = values.shape[1]
    tables, length = [values], 1
    while 2 * length <= count:
        previous = tables[-1]
        tables.append(torch.maximum(previous, pad(previous[:, length:], (0, length), value=-torch.inf)))
        length *= 2
    table = torch.cat(tables, dim=1)
    span = last - first + 1
    power = torch.log2(span.to(torch.float32)).floor().to(torch.int64)  # exact for lengths of samples along a ray
    row = power * count
    begin, end = row + first, row + last + 1 - (1 << power)
    return torch.maximum(table.gather(1, begin), table.gather(1, end))


def resample(
    edges: Float[Tensor, "k edges"], weights: Float[Tensor, "k bins"], count: int, ctx: Context, *, per_ray: bool
) -> Float[Tensor, "k count_plus_1"]:
    """Edges of ``count`` intervals around points that are drawn from a histogram (multinerf, ``sample_intervals``).

    Edges lie halfway between neighbouring points; the first and the last interval are as far beyond their point as before it,
    within the histogram.

    Args:
        edges: of the histogram.
        weights: unnormalised probability of its bins, >= 0, and > 0 for some of each ray.
        count: number of intervals, at least 2.
        ctx: in training, points are drawn at random.
        per_ray: whether a ray's quantiles are moved together.
    """
    with torch.no_grad():
        points = sample_pdf(edges, weights, quantiles(len(edges), count, ctx, like=weights, per_ray=per_ray))
        between = (points[:, 1:] + points[:, :-1]) / 2
        first = (2 * points[:, :1] - between[:, :1]).maximum(edges[:, :1])
        last = (2 * points[:, -1:] - between[:, -1:]).minimum(edges[:, -1:])
        return torch.cat([first, between, last], dim=1)
