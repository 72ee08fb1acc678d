"""Where a position lies in a level of a hash grid: cells, entries and weights, for the kernels to inline."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import index, inlined, ordered
from invgraphics.kernels.reference.hash import PRIMES

CHUNK = 1024
"""Points that are taken through a level before the next one, so that the level's entries stay in the cache."""
BLOCK = 128
"""Points whose entries and weights are found together, several at a time in vector registers, before the table is read."""

_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
ZERO, ONE = np.float32(0.0), np.float32(1.0)
UNIT = index(1)
_V1, _V2, _V3, _V4, _V5, _V6, _V7 = (index(BLOCK * vertex) for vertex in range(1, 8))


@inlined
def axis(coordinate, cells):
    """Lower vertex along one axis and the fraction beyond it; in float64, as fine levels leave float32 few digits."""
    position = np.float64(coordinate) * np.float64(cells)
    position = position if position > 0.0 else 0.0
    position = min(position, np.float64(cells))
    # Through signed 32-bit integers: processors convert nothing else quickly. The last vertex belongs to the last cell.
    lower = max(min(np.int32(position), np.int32(cells - 1)), np.int32(0))
    return np.uint32(lower), np.float32(position - np.float64(lower))


@inlined
def _stored(x, y, z, cells):
    """Entries of the 8 vertices of a cell (x fastest) on a level that holds them all."""
    edge = np.uint32(cells + 1)
    a = x + edge * (y + edge * z)
    b, c = a + edge, a + edge * edge
    d = b + edge * edge
    return a, a + UNIT, b, b + UNIT, c, c + UNIT, d, d + UNIT


@inlined
def _hashed(x, y, z, mask):
    """Entries of the 8 vertices of a cell (x fastest) on a level whose vertices share entries."""
    y0, z0 = y * _PRIME_Y, z * _PRIME_Z
    y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    u = x + UNIT
    return (
        (x ^ a) & mask, (u ^ a) & mask, (x ^ b) & mask, (u ^ b) & mask,
        (x ^ c) & mask, (u ^ c) & mask, (x ^ d) & mask, (u ^ d) & mask,
    )  # fmt: skip


@inlined
def corners(point, cells, mask):
    """Entries of the 8 vertices around a position (x fastest), and the fractions; ``mask`` is 0 on dense levels."""
    x, fx = axis(point[0], cells)
    y, fy = axis(point[1], cells)
    z, fz = axis(point[2], cells)
    entries = _stored(x, y, z, cells) if mask == 0 else _hashed(x, y, z, mask)
    return entries, (fx, fy, fz)


@inlined
def rows_of(e, offset, width):
    """Where the entries' features begin in the flat table."""
    return (
        (offset + e[0]) * width, (offset + e[1]) * width, (offset + e[2]) * width, (offset + e[3]) * width,
        (offset + e[4]) * width, (offset + e[5]) * width, (offset + e[6]) * width, (offset + e[7]) * width,
    )  # fmt: skip


@inlined
def weights_of(f):
    """Trilinear weights of the 8 vertices (x fastest)."""
    x, y, z = f
    p, q = ONE - x, ONE - y
    low, high = ONE - z, z
    a, b, c, d = q * low, y * low, q * high, y * high
    return p * a, x * a, p * b, x * b, p * c, x * c, p * d, x * d


@inlined
def _put(values, n, v):
    values[n], values[n + _V1], values[n + _V2], values[n + _V3] = v[0], v[1], v[2], v[3]
    values[n + _V4], values[n + _V5], values[n + _V6], values[n + _V7] = v[4], v[5], v[6], v[7]


@inlined
def locate(x, y, z, block, level, width, rows, weights):
    """Rows in the flat table and weights of the vertices around the points of a block: vertex by vertex, `BLOCK` points each.

    ``block`` is the first point and the number of points, ``level`` the cells along an edge, the first entry and the mask.
    """
    first, count = block
    cells, offset, mask = level[0], np.uint32(level[1]), np.uint32(level[2])
    wide = np.uint32(width)
    # One loop for each kind of level, so that neither holds a branch.
    if mask == 0:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = axis(x[first + n], cells), axis(y[first + n], cells), axis(z[first + n], cells)
            _put(rows, n, rows_of(_stored(i, j, k, cells), offset, wide))
            _put(weights, n, weights_of((a, b, c)))
    else:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = axis(x[first + n], cells), axis(y[first + n], cells), axis(z[first + n], cells)
            _put(rows, n, rows_of(_hashed(i, j, k, mask), offset, wide))
            _put(weights, n, weights_of((a, b, c)))


@inlined
def at_vertices(values, n):
    """The 8 numbers of the block's n-th point."""
    return (
        values[n], values[n + _V1], values[n + _V2], values[n + _V3],
        values[n + _V4], values[n + _V5], values[n + _V6], values[n + _V7],
    )  # fmt: skip


@ordered
def blend(table, r, w, k):
    """Weighted sum of the vertices' k-th features."""
    a, b = w[0] * table[r[0] + k] + w[1] * table[r[1] + k], w[2] * table[r[2] + k] + w[3] * table[r[3] + k]
    c, d = w[4] * table[r[4] + k] + w[5] * table[r[5] + k], w[6] * table[r[6] + k] + w[7] * table[r[7] + k]
    return (a + b) + (c + d)


@inlined
def spread(to_table, r, w, k, g):
    """Add a gradient to the vertices' k-th features."""
    to_table[r[0] + k] += w[0] * g
    to_table[r[1] + k] += w[1] * g
    to_table[r[2] + k] += w[2] * g
    to_table[r[3] + k] += w[3] * g
    to_table[r[4] + k] += w[4] * g
    to_table[r[5] + k] += w[5] * g
    to_table[r[6] + k] += w[6] * g
    to_table[r[7] + k] += w[7] * g
