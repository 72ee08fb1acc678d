"""Where a position lies in a level of a hash grid: cells, entries and weights, for the kernels to inline."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import index, inlined, ordered
from invgraphics.kernels.numba.simd.instructions import fma, prefetch_pair
from invgraphics.kernels.reference.hash import PRIMES

CHUNK = 4096
"""Points that are taken through a level before the next one, so that the level's entries stay in the cache."""
BLOCK = 128
"""Points whose entries and weights are found together, several at a time in vector registers, before the table is read."""

_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
ZERO, ONE = np.float32(0.0), np.float32(1.0)
_u32, _NEXT = np.uint32, np.uint32(1)
_V1, _V2, _V3, _V4, _V5, _V6, _V7 = (index(BLOCK * vertex) for vertex in range(1, 8))


@inlined
def axis(coordinate, cells):
    """Lower vertex along one axis and the fraction beyond it, which is rounded only once: fine levels leave it few digits."""
    inside = min(coordinate if coordinate > ZERO else ZERO, ONE)
    edge = np.float32(cells)
    # Through signed 32-bit integers: processors convert nothing else quickly. The last vertex belongs to the last cell.
    lower = max(min(np.int32(inside * edge), np.int32(cells - 1)), np.int32(0))
    fraction = fma(inside, edge, -np.float32(lower))
    # The product may have been rounded up to the next vertex.
    over = fraction < ZERO
    lower, fraction = (lower - np.int32(1), fraction + ONE) if over else (lower, fraction)
    return np.uint32(lower), fraction


# Numba widens what two 32-bit integers make to 64 bits; every step says that it stays narrow, or vectors hold half as many.


@inlined
def _stored(x, y, z, cells):
    """Entries of the 8 vertices of a cell (x fastest) on a level that holds them all."""
    edge = _u32(cells + 1)
    plane = _u32(edge * edge)
    a = _u32(x + _u32(edge * y) + _u32(plane * z))
    b, c, d = _u32(a + edge), _u32(a + plane), _u32(a + edge + plane)
    return a, _u32(a + _NEXT), b, _u32(b + _NEXT), c, _u32(c + _NEXT), d, _u32(d + _NEXT)


@inlined
def _hashed(x, y, z, mask):
    """Entries of the 8 vertices of a cell (x fastest) on a level whose vertices share entries."""
    y0, z0, u = _u32(y * _PRIME_Y), _u32(z * _PRIME_Z), _u32(x + _NEXT)
    y1, z1 = _u32(y0 + _PRIME_Y), _u32(z0 + _PRIME_Z)
    a, b, c, d = _u32(y0 ^ z0), _u32(y1 ^ z0), _u32(y0 ^ z1), _u32(y1 ^ z1)
    return (
        _u32(_u32(x ^ a) & mask), _u32(_u32(u ^ a) & mask), _u32(_u32(x ^ b) & mask), _u32(_u32(u ^ b) & mask),
        _u32(_u32(x ^ c) & mask), _u32(_u32(u ^ c) & mask), _u32(_u32(x ^ d) & mask), _u32(_u32(u ^ d) & mask),
    )  # fmt: skip


@inlined
def corners(point, cells, mask):
    """Entries of the 8 vertices around a position (x fastest), and the fractions; ``mask`` is 0 on dense levels."""
    x, fx = axis(point[0], cells)
    y, fy = axis(point[1], cells)
    z, fz = axis(point[2], cells)
    entries = _stored(x, y, z, cells) if mask == 0 else _hashed(x, y, z, _u32(mask))
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
def _from(offset, e):
    """The level's entries, counted from the beginning of the table."""
    return (
        _u32(offset + e[0]), _u32(offset + e[1]), _u32(offset + e[2]), _u32(offset + e[3]),
        _u32(offset + e[4]), _u32(offset + e[5]), _u32(offset + e[6]), _u32(offset + e[7]),
    )  # fmt: skip


@inlined
def locate(x, y, z, block, level, entries, weights):
    """Entries and weights of the vertices around the points of a block: vertex by vertex, `BLOCK` points each.

    ``block`` is the first point and the number of points, ``level`` the cells along an edge, the first entry and the mask.
    """
    first, count = block
    cells, offset, mask = level[0], _u32(level[1]), _u32(level[2])
    # One loop for each kind of level, so that neither holds a branch.
    if mask == 0:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = axis(x[first + n], cells), axis(y[first + n], cells), axis(z[first + n], cells)
            _put(entries, n, _from(offset, _stored(i, j, k, cells)))
            _put(weights, n, weights_of((a, b, c)))
    else:
        for number in range(count):
            n = index(number)
            (i, a), (j, b), (k, c) = axis(x[first + n], cells), axis(y[first + n], cells), axis(z[first + n], cells)
            _put(entries, n, _from(offset, _hashed(i, j, k, mask)))
            _put(weights, n, weights_of((a, b, c)))


@inlined
def ask_for(table, entries, count):
    """Have the entries of so many points of a block fetched, which a processor foresees only a few points ahead.

    Of two vertices that are neighbours along x, one is asked for: their entries nearly always share a cache line.
    """
    for vertex in range(0, 8, 2):
        for number in range(count):
            prefetch_pair(table, entries[index(vertex * BLOCK) + index(number)])


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
