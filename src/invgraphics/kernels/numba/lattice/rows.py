"""Interpolation of features at the corners of cells, and its transpose, for a block of points; inlined into the kernels.

Channels are the lanes. Where a row has more than `LANES` of them but no whole number of registers, its last register overlaps
the one before: full loads cost less than masked ones.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import ZERO
from invgraphics.kernels.numba.lattice.cells import BLOCK, EMPTY, MULTIPLY, WRITE
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined
from invgraphics.kernels.numba.simd.instructions import prefetch_at
from invgraphics.kernels.numba.simd.lanes import broadcast, lane_index, load, store, where
from invgraphics.kernels.numba.simd.partial import floats_at, load_first, store_first

AHEAD = 8
"""Points ahead of which rows are prefetched."""
LARGE = 1 << 15
"""Features of a lattice that fills more than a cache close to the core: its rows are prefetched."""

_V1, _V2, _V3, _V4, _V5, _V6, _V7 = (index(BLOCK * vertex) for vertex in range(1, 8))


@inlined
def prefetch_cells(features, lattice, entries, n):
    """Prefetch the rows around a block's n-th point; in a dense lattice, neighbours along the last axis lie side by side."""
    channels, dense = index(lattice.channels), lattice.links == 0
    for corner in range(lattice.corners // 2 if dense else lattice.corners):
        row = entries[index(corner * BLOCK) + n]
        if row != EMPTY:
            for k in range(0, lattice.channels * (2 if dense else 1), GROUP):
                prefetch_at(features, index(row) * channels + index(k))


@inlined
def _row(features, row, channels, k):
    return load(features, index(row) * channels + k)


@inlined
def interpolate_dense(features, corners, entries, weights, n, channels, k):
    """Interpolate `LANES` features, k, k + 1, ..., of the n-th point; every corner has a row."""
    total = weights[n] * _row(features, entries[n], channels, k)
    total = total + weights[n + _V1] * _row(features, entries[n + _V1], channels, k)
    if corners > 2:
        more = weights[n + _V2] * _row(features, entries[n + _V2], channels, k)
        total = total + (more + weights[n + _V3] * _row(features, entries[n + _V3], channels, k))
    if corners > 4:
        more = weights[n + _V4] * _row(features, entries[n + _V4], channels, k)
        more = more + weights[n + _V5] * _row(features, entries[n + _V5], channels, k)
        more = more + weights[n + _V6] * _row(features, entries[n + _V6], channels, k)
        total = total + (more + weights[n + _V7] * _row(features, entries[n + _V7], channels, k))
    return total


@inlined
def load_part(flat, at, part):
    """Load ``part`` values, at most `LANES`."""
    return load(flat, at) if part == LANES else load_first(flat, at, part)


@inlined
def store_part(flat, at, part, value):
    """Store the first ``part`` values, at most `LANES`."""
    if part == LANES:
        store(flat, at, value)
    else:
        store_first(flat, at, part, value)


@inlined
def _interpolate_any(features, corners, entries, weights, n, channels, k, part):
    """Interpolate ``part`` features; empty vertices are left out."""
    total = broadcast(ZERO)
    for corner in range(corners):
        at = index(corner * BLOCK) + n
        if entries[at] != EMPTY:
            total = total + weights[at] * load_part(features, index(entries[at]) * channels + k, part)
    return total


@inlined
def _combined(old, value, mode, overlap):
    """What the output becomes; the first ``overlap`` lanes are done already."""
    return where(lane_index() < overlap, old, old * value if mode == MULTIPLY else old + value)


@inlined
def interpolate_block(lattice, entries, weights, points, mode, out, first, stride):
    """Interpolate one lattice at some points of a block, into ``stride`` values of ``out`` for each.

    Args:
        lattice: a `RECORD`.
        entries: rows of the corners (see `locate_block`).
        weights: their weights.
        points: indices of the points in the block, ascending, and their number.
        mode: `WRITE`, `ADD` or `MULTIPLY`.
        out: flat float32.
        first: where the values of the block's first point begin (uint64).
        stride: values per point (uint64).
    """
    chosen, count = points
    channels, corners = index(lattice.channels), lattice.corners
    features = floats_at(lattice.features, lattice.rows * lattice.channels)
    part, last = min(channels, LANES), max(lattice.channels - GROUP, 0)
    dense, large = lattice.links == 0 and part == LANES, lattice.rows * lattice.channels >= LARGE
    for number in range(count):
        n = index(chosen[number])
        at = first + n * stride
        if large and number + AHEAD < count:
            prefetch_cells(features, lattice, entries, index(chosen[number + AHEAD]))
        for start in range(0, lattice.channels, GROUP):
            k = index(min(start, last))
            if dense:
                value = interpolate_dense(features, corners, entries, weights, n, channels, k)
            else:
                value = _interpolate_any(features, corners, entries, weights, n, channels, k, part)
            if mode != WRITE:
                value = _combined(load_part(out, at + k, part), value, mode, np.float32(start - min(start, last)))
            store_part(out, at + k, part, value)


@inlined
def _add_row(grad_rows, row, channels, k, weight, value):
    at = index(row) * channels + k
    store(grad_rows, at, load(grad_rows, at) + weight * value)


@inlined
def scatter_dense(grad_rows, corners, entries, weights, n, channels, k, value):
    """Transpose of `interpolate_dense`: one after the other, because corners may share a row."""
    _add_row(grad_rows, entries[n], channels, k, weights[n], value)
    _add_row(grad_rows, entries[n + _V1], channels, k, weights[n + _V1], value)
    if corners > 2:
        _add_row(grad_rows, entries[n + _V2], channels, k, weights[n + _V2], value)
        _add_row(grad_rows, entries[n + _V3], channels, k, weights[n + _V3], value)
    if corners > 4:
        _add_row(grad_rows, entries[n + _V4], channels, k, weights[n + _V4], value)
        _add_row(grad_rows, entries[n + _V5], channels, k, weights[n + _V5], value)
        _add_row(grad_rows, entries[n + _V6], channels, k, weights[n + _V6], value)
        _add_row(grad_rows, entries[n + _V7], channels, k, weights[n + _V7], value)


@inlined
def scatter_any(grad_rows, corners, entries, weights, n, channels, k, part, owned, value):
    """Add ``part`` values to those corners whose rows are ``owned``."""
    start, end = owned
    for corner in range(corners):
        at = index(corner * BLOCK) + n
        row = entries[at]
        if row >= start and row < end:
            place = index(row) * channels + k
            store_part(grad_rows, place, part, load_part(grad_rows, place, part) + weights[at] * value)


@inlined
def scatter_block(lattice, entries, weights, points, owned, source, grad_rows):
    """Add the gradients of some points of a block to the ``owned`` rows among those of their corners.

    Args:
        lattice: a `RECORD`.
        entries: rows of the corners.
        weights: their weights.
        points: as in `interpolate_block`.
        owned: first row, and the row after the last one.
        source: flat gradients of the interpolated features, where those of the block's first point begin, and stride.
        grad_rows: flat gradient of the lattice's features.
    """
    (chosen, count), (gradient, first, stride) = points, source
    channels, corners = index(lattice.channels), lattice.corners
    whole, rest = lattice.channels // GROUP * GROUP, index(lattice.channels % GROUP)
    dense, large = lattice.links == 0, lattice.rows * lattice.channels >= LARGE
    last = index((corners - 1) * BLOCK)
    for number in range(count):
        n = index(chosen[number])
        at = first + n * stride
        if large and number + AHEAD < count:
            prefetch_cells(grad_rows, lattice, entries, index(chosen[number + AHEAD]))
        # Rows of a dense cell lie between those of its first and last corner.
        inside = dense and entries[n] >= owned[0] and entries[n + last] < owned[1]
        for start in range(0, whole, GROUP):
            k = index(start)
            value = load(gradient, at + k)
            if inside:
                scatter_dense(grad_rows, corners, entries, weights, n, channels, k, value)
            else:
                scatter_any(grad_rows, corners, entries, weights, n, channels, k, LANES, owned, value)
        if rest > 0:
            k = index(whole)
            value = load_first(gradient, at + k, rest)
            scatter_any(grad_rows, corners, entries, weights, n, channels, k, rest, owned, value)
