"""Products of two dense lattices whose rows are whole registers, such as a plane times a line of VM; inlined into the kernels.

Both factors of a product stay in registers, where `rows` and `backward` pass any number of factors through a block's scratch.
"""

from __future__ import annotations

from invgraphics.kernels.numba.lattice.cells import BLOCK, corners_of
from invgraphics.kernels.numba.lattice.rows import (
    AHEAD,
    LARGE,
    interpolate_dense,
    prefetch_cells,
    scatter_any,
    scatter_dense,
)
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined
from invgraphics.kernels.numba.simd.lanes import load, store
from invgraphics.kernels.numba.simd.partial import floats_at


@inlined
def is_pair(lattices, first, end):
    """Whether a group is a product that this module computes."""
    if end - first != 2:
        return False
    a, b = lattices[first], lattices[first + 1]
    return a.links == 0 and b.links == 0 and a.channels == b.channels and a.channels % GROUP == 0


@inlined
def multiply_pair(a, b, corners_a, corners_b, points, out, first, stride):
    """Store the product of two lattices' features at some points of a block; arguments as of `rows.interpolate_block`."""
    (chosen, count), (rows_a, weights_a), (rows_b, weights_b) = points, corners_a, corners_b
    channels, size_a, size_b = index(a.channels), a.rows * a.channels, b.rows * b.channels
    features_a, features_b = floats_at(a.features, size_a), floats_at(b.features, size_b)
    for number in range(count):
        n = index(chosen[number])
        if number + AHEAD < count:
            ahead = index(chosen[number + AHEAD])
            if size_a >= LARGE:
                prefetch_cells(features_a, a, rows_a, ahead)
            if size_b >= LARGE:
                prefetch_cells(features_b, b, rows_b, ahead)
        for begin in range(0, a.channels, GROUP):
            k = index(begin)
            value = interpolate_dense(features_a, a.corners, rows_a, weights_a, n, channels, k)
            value = value * interpolate_dense(features_b, b.corners, rows_b, weights_b, n, channels, k)
            store(out, first + n * stride + k, value)


@inlined
def scatter_pair(a, b, scratch, members, points, owned, source, written):
    """Add the gradients of both factors at some points of a block to rows of theirs.

    Args:
        a: the factor of which only ``owned`` rows are written.
        b: the other factor, of which all rows are.
        scratch: of the job, with the corners of both.
        members: their numbers in the group.
        points: indices of the points, their number; indices of those among them that write the other factor, and their number.
        owned: first row, and the row after the last one; empty where the factor is not written.
        source: flat gradients of the product, where those of the block's first point begin, and stride.
        written: addresses of both gradients; 0 where a factor is not written.
    """
    (touched, count, led, leaders), (gradient, first, stride) = points, source
    (rows_a, weights_a), (rows_b, weights_b) = corners_of(scratch, members[0]), corners_of(scratch, members[1])
    channels, size_a, size_b = index(a.channels), a.rows * a.channels, b.rows * b.channels
    features_a, features_b = floats_at(a.features, size_a), floats_at(b.features, size_b)
    grad_a, grad_b = floats_at(written[0], size_a), floats_at(written[1], size_b)
    last, leader = index((a.corners - 1) * BLOCK), 0
    for number in range(count):
        n = index(touched[number])
        if number + AHEAD < count and size_a >= LARGE:
            ahead = index(touched[number + AHEAD])
            prefetch_cells(features_a, a, rows_a, ahead)
            prefetch_cells(grad_a, a, rows_a, ahead)
        leads = leader < leaders and led[leader] == touched[number]
        leader += leads
        inside = rows_a[n] >= owned[0] and rows_a[n + last] < owned[1]
        for begin in range(0, a.channels, GROUP):
            k = index(begin)
            received = load(gradient, first + n * stride + k)
            if owned[0] < owned[1]:
                value = received * interpolate_dense(features_b, b.corners, rows_b, weights_b, n, channels, k)
                if inside:
                    scatter_dense(grad_a, a.corners, rows_a, weights_a, n, channels, k, value)
                else:
                    scatter_any(grad_a, a.corners, rows_a, weights_a, n, channels, k, LANES, owned, value)
            if leads and written[1] != 0:
                value = received * interpolate_dense(features_a, a.corners, rows_a, weights_a, n, channels, k)
                scatter_dense(grad_b, b.corners, rows_b, weights_b, n, channels, k, value)
