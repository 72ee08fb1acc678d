"""Weighted sums of consecutive rows, plain torch."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor


def segment_sums(
    values: Float[Tensor, "r f"], weights: Float[Tensor, " r"], segment: Int[Tensor, " r"], segments: int
) -> Float[Tensor, "n f"]:
    """See `invgraphics.kernels.segments.segment_sums`."""
    return values.new_zeros(segments, values.shape[1]).index_add(0, segment, weights[:, None] * values)
