"""Trilinear cells of a hash grid: corner entries, weights, interpolation and its transpose, inlined into the kernels."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import index, inlined, ordered
from invgraphics.kernels.numba.simd.instructions import fma, prefetch_pair
from invgraphics.kernels.reference.hash import PRIMES

CHUNK = 4096
"""Points processed per level before the next one, so that the level's entries stay in the cache."""
BLOCK = 128
"""Points whose entries and weights are computed together, vectorised, before the table is read."""

_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
ZERO, ONE = np.float32(0.0), np.float32(1.0)
_u32, _NEXT = np.uint32, np.uint32(1)
_V1, _V2, _V3, _V4, _V5, _V6, _V7 = (index(BLOCK * vertex) for vertex in range(1, 8))


@inlined
def axis_cell(coordinate, cells):
    """Lower vertex along one axis and the fraction beyond it, rounded only once: fine levels leave it few digits."""
    inside = min(coordinate if coordinate > ZERO else ZERO, ONE)
    edge = np.float32(cells)
    # Through signed 32-bit integers: processors convert nothing else quickly. The last vertex belongs to the last cell.
    lower = max(min(np.int32(inside * edge), np.int32(cells - 1)), np.int32(0))
    fraction = fma(inside, edge, -np.float32(lower))
    # The product may have been rounded up to the next vertex.
    over = fraction < ZERO
    lower, fraction = (lower - np.int32(1), fraction + ONE) if over else (lower, fraction)
    return np.uint32(lower), fraction


# Numba widens 32-bit integer arithmetic to 64 bits; every step casts back, or vectors hold half as many values.


@inlined
def dense_entries(x, y, z, cells):
    """Entries of the 8 corners of a cell (x fastest) on a dense level."""
    edge = _u32(cells + 1)
    plane = _u32(edge * edge)
    a = _u32(x + _u32(edge * y) + _u32(plane * z))
    b, c, d = _u32(a + edge), _u32(a + plane), _u32(a + edge + plane)
    return a, _u32(a + _NEXT), b, _u32(b + _NEXT), c, _u32(c + _NEXT), d, _u32(d + _NEXT)


@inlined
def hashed_entries(x, y, z, mask):
    """Entries of the 8 corners of a cell (x fastest) on a hashed level."""
    y0, z0, u = _u32(y * _PRIME_Y), _u32(z * _PRIME_Z), _u32(x + _NEXT)
    y1, z1 = _u32(y0 + _PRIME_Y), _u32(z0 + _PRIME_Z)
    a, b, c, d = _u32(y0 ^ z0), _u32(y1 ^ z0), _u32(y0 ^ z1), _u32(y1 ^ z1)
    return (
        _u32(_u32(x ^ a) & mask), _u32(_u32(u ^ a) & mask), _u32(_u32(x ^ b) & mask), _u32(_u32(u ^ b) & mask),
        _u32(_u32(x ^ c) & mask), _u32(_u32(u ^ c) & mask), _u32(_u32(x ^ d) & mask), _u32(_u32(u ^ d) & mask),
    )  # fmt: skip


@inlined
def feature_rows(e, offset, width):
    """Offsets of the entries' features in the flat table."""
    return (
        (offset + e[0]) * width, (offset + e[1]) * width, (offset + e[2]) * width, (offset + e[3]) * width,
        (offset + e[4]) * width, (offset + e[5]) * width, (offset + e[6]) * width, (offset + e[7]) * width,
    )  # fmt: skip


@inlined
def trilinear_weights(f):
    """Trilinear weights of the 8 corners (x fastest)."""
    x, y, z = f
    p, q = ONE - x, ONE - y
    low, high = ONE - z, z
    a, b, c, d = q * low, y * low, q * high, y * high
    return p * a, x * a, p * b, x * b, p * c, x * c, p * d, x * d


@inlined
def store_corners(values, n, v):
    """Store the 8 corner values of the block's n-th point."""
    values[n], values[n + _V1], values[n + _V2], values[n + _V3] = v[0], v[1], v[2], v[3]
    values[n + _V4], values[n + _V5], values[n + _V6], values[n + _V7] = v[4], v[5], v[6], v[7]


@inlined
def table_entries(offset, e):
    """Entries of a level as entries of the whole table."""
    return (
        _u32(offset + e[0]), _u32(offset + e[1]), _u32(offset + e[2]), _u32(offset + e[3]),
        _u32(offset + e[4]), _u32(offset + e[5]), _u32(offset + e[6]), _u32(offset + e[7]),
    )  # fmt: skip


@inlined
def locate_block(x, y, z, block, level, entries, weights):
    """Entries and weights of the corners around the points of a block: corner-major, `BLOCK` points each.

    ``block`` is the first point and the number of points, ``level`` the cells along an edge, the first entry and the mask.
    """
    first, count = block
    cells, offset, mask = level[0], _u32(level[1]), _u32(level[2])
    # One loop per kind of level: branches would prevent vectorisation.
    if mask == 0:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = (
                axis_cell(x[first + n], cells),
                axis_cell(y[first + n], cells),
                axis_cell(z[first + n], cells),
            )
            store_corners(entries, n, table_entries(offset, dense_entries(i, j, k, cells)))
            store_corners(weights, n, trilinear_weights((a, b, c)))
    else:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = (
                axis_cell(x[first + n], cells),
                axis_cell(y[first + n], cells),
                axis_cell(z[first + n], cells),
            )
            store_corners(entries, n, table_entries(offset, hashed_entries(i, j, k, mask)))
            store_corners(weights, n, trilinear_weights((a, b, c)))


@inlined
def prefetch_entries(table, entries, count):
    """Prefetch the entries of the first ``count`` points of a block: out-of-order execution looks only a few points ahead.

    Of two corners that are neighbours along x, one suffices: their entries nearly always share a cache line.
    """
    for vertex in range(0, 8, 2):
        for number in range(count):
            prefetch_pair(table, entries[index(vertex * BLOCK) + index(number)])


@inlined
def load_corners(values, n):
    """Load the 8 corner values of the block's n-th point."""
    return (
        values[n], values[n + _V1], values[n + _V2], values[n + _V3],
        values[n + _V4], values[n + _V5], values[n + _V6], values[n + _V7],
    )  # fmt: skip


@ordered
def interpolate(table, r, w, k):
    """Trilinear interpolation of the k-th feature."""
    a, b = w[0] * table[r[0] + k] + w[1] * table[r[1] + k], w[2] * table[r[2] + k] + w[3] * table[r[3] + k]
    c, d = w[4] * table[r[4] + k] + w[5] * table[r[5] + k], w[6] * table[r[6] + k] + w[7] * table[r[7] + k]
    return (a + b) + (c + d)


@inlined
def scatter_add(grad_table, r, w, k, g):
    """Transpose of `interpolate`: add a gradient to the corners' k-th features."""
    grad_table[r[0] + k] += w[0] * g
    grad_table[r[1] + k] += w[1] * g
    grad_table[r[2] + k] += w[2] * g
    grad_table[r[3] + k] += w[3] * g
    grad_table[r[4] + k] += w[4] * g
    grad_table[r[5] + k] += w[5] * g
    grad_table[r[6] + k] += w[6] * g
    grad_table[r[7] + k] += w[7] * g
