"""Reads and writes of a block's entries: interpolation, its transpose, and the corners' products with a cotangent."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import (
    BLOCK,
    ZERO,
    axis_cell,
    dense_entries,
    feature_rows,
    hashed_entries,
    interpolate,
    load_corners,
    scatter_add,
    store_corners,
    table_entries,
)
from invgraphics.kernels.numba.runtime import index, inlined
from invgraphics.kernels.numba.simd.instructions import dot_pair, interpolate_pair, scatter_add_pair

UNIT, TWO = index(1), index(2)
_STRIDE = index(BLOCK)


@inlined
def block_at(first, until):
    """First point and number of points of the block that begins at ``first``."""
    return index(first), min(BLOCK, until - first)


@inlined
def gather_block(table, entries, weights, block, column, width, out):
    """Interpolate the features of a block's points; the usual two are read as a pair."""
    first, count = block
    if width == TWO:
        for point in range(count):
            n = index(point)
            low, high = interpolate_pair(table, load_corners(entries, n), load_corners(weights, n))
            out[first + n, column] = low
            out[first + n, column + UNIT] = high
    else:
        for point in range(count):
            n = index(point)
            r, w = feature_rows(load_corners(entries, n), index(0), width), load_corners(weights, n)
            for feature in range(width):
                out[first + n, column + index(feature)] = interpolate(table, r, w, index(feature))


@inlined
def scatter_block(gradient, entries, weights, block, column, width, grad_table):
    """The transpose of `gather_block`."""
    first, count = block
    if width == TWO:
        for point in range(count):
            n = index(point)
            low, high = gradient[first + n, column], gradient[first + n, column + UNIT]
            scatter_add_pair(grad_table, load_corners(entries, n), load_corners(weights, n), low, high)
    else:
        for point in range(count):
            n = index(point)
            r, w = feature_rows(load_corners(entries, n), index(0), width), load_corners(weights, n)
            for feature in range(width):
                scatter_add(grad_table, r, w, index(feature), gradient[first + n, column + index(feature)])


@inlined
def _dot(table, row, gradient, point, column, width):
    """Product of an entry's features with a point's cotangent of a level."""
    total = ZERO
    for feature in range(width):
        k = index(feature)
        total += gradient[point, column + k] * table[row + k]
    return total


@inlined
def dot_block(table, entries, gradient, block, column, width, products):
    """Products of the corners' features with the cotangents of a block's points, corner-major as the entries."""
    first, count = block
    if width == TWO:
        for point in range(count):
            n = index(point)
            low, high = gradient[first + n, column], gradient[first + n, column + UNIT]
            store_corners(products, n, dot_pair(table, load_corners(entries, n), low, high))
    else:
        for point in range(count):
            n, i = index(point), first + index(point)
            for vertex in range(8):
                at = n + index(vertex) * _STRIDE
                products[at] = _dot(table, index(entries[at]) * width, gradient, i, column, width)


@inlined
def locate_fractions(x, y, z, block, level, entries, fractions):
    """Entries of the corners around the points of a block, as `locate_block` stores them, and the fractions along the axes."""
    first, count = block
    cells, offset, mask = level[0], np.uint32(level[1]), np.uint32(level[2])
    if mask == 0:
        for number in range(count):
            n = index(number)
            i, fractions[0, n] = axis_cell(x[first + n], cells)
            j, fractions[1, n] = axis_cell(y[first + n], cells)
            k, fractions[2, n] = axis_cell(z[first + n], cells)
            store_corners(entries, n, table_entries(offset, dense_entries(i, j, k, cells)))
    else:
        for number in range(count):
            n = index(number)
            i, fractions[0, n] = axis_cell(x[first + n], cells)
            j, fractions[1, n] = axis_cell(y[first + n], cells)
            k, fractions[2, n] = axis_cell(z[first + n], cells)
            store_corners(entries, n, table_entries(offset, hashed_entries(i, j, k, mask)))
