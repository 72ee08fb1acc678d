"""Weighted sums of the rows that belong together, as those of a sample's neighbours."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.checks import check_rows
from invgraphics.kernels.dispatch import choose


def segment_sums(
    values: Float[Tensor, "r f"], weights: Float[Tensor, " r"], segment: Int[Tensor, " r"], segments: int
) -> Float[Tensor, "n f"]:
    """Sum of ``weights`` times ``values`` over the rows of each segment.

    Compiled for float32 on the CPU, where sums have a fixed order; elsewhere, CUDA included, the reference runs.

    Args:
        values: a row of features per entry.
        weights: one per entry.
        segment: the segment of each entry, ascending, in [0, segments).
        segments: their number.

    Returns:
        A row per segment, zero for one without entries; differentiable once in ``values`` and ``weights``.

    Raises:
        ValueError: values, weights and segments of several lengths.
        IndexError: the first or the last entry belongs to no segment; a RuntimeError from the reference.
    """
    check_rows("rows of values", len(values), weights=weights, segment=segment)
    return choose("segment_sums", values, weights)(values, weights, segment, segments)
