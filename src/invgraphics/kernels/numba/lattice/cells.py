"""Corners of lattice cells and interpolation at them, for a block of points at a time; inlined into the kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from invgraphics.core.lattice import Combination, Lattice
from invgraphics.kernels.numba.hash.cells import ONE, ZERO, axis_cell, trilinear_weights
from invgraphics.kernels.numba.runtime import LANES, index, inlined
from invgraphics.kernels.numba.simd.lanes import broadcast, load, store
from invgraphics.kernels.numba.simd.partial import floats_at, load_first, store_first, words_at

BLOCK = 128
"""Points whose corners are found together, vectorised, before features are read."""
CORNERS = 8
EMPTY = np.uint32(0xFFFFFFFF)
"""Row of an empty vertex."""
WRITE, ADD, MULTIPLY = 0, 1, 2
"""What becomes of the output's earlier content."""

RECORD = np.dtype(
    [
        (name, np.int64)
        for name in (
            "features",  # addresses; links: 0 for a dense lattice
            "links",
            "rows",
            "channels",
            "corners",
            *("axis0", "axis1", "axis2"),  # column of the positions, by axis of the lattice; unused: 0
            *("size0", "size1", "size2"),  # vertices; unused axes: 1
            "column",  # first feature in the output
            "mode",
            *("group", "group_end"),  # lattices whose product an output is
        )
    ]
)
"""One lattice, as kernels read it."""

_u32, _UNIT = np.uint32, index(1)


def records(lattices: Sequence[Lattice], combine: Combination) -> np.ndarray:
    """Table of lattices whose tensors are contiguous; the caller keeps them alive."""
    table = np.zeros(len(lattices), RECORD)
    group = {"concat": 1, "sum": 1, "vm": 2, "cp": len(lattices)}[combine]
    for number, lattice in enumerate(lattices):
        first, place = number - number % group, table[number]
        place["features"] = lattice.features.data_ptr()
        place["links"] = 0 if lattice.links is None else lattice.links.data_ptr()
        place["rows"], place["channels"], place["corners"] = len(lattice.rows), lattice.channels, 2 ** len(lattice.axes)
        for axis in range(3):
            used = axis < len(lattice.axes)
            place[f"axis{axis}"] = lattice.columns[axis] if used else 0
            place[f"size{axis}"] = lattice.resolution[axis] if used else 1
        before = 0 if combine in ("sum", "cp") else sum(lattices[k].channels for k in range(0, first, group))
        place["column"], place["group"], place["group_end"] = before, first, first + group
        place["mode"] = MULTIPLY if number > first else ADD if combine == "sum" and number else WRITE
    return table


@inlined
def _keep(values, n, v, corners):
    """Store the values of the n-th point's corners, corner-major."""
    for corner in range(corners):
        values[index(corner * BLOCK) + n] = v[corner]


@inlined
def _rows_2(i, j, size0, size1):
    """Rows of a rectangle's corners; the neighbour on an axis with a single vertex is the vertex itself."""
    a, b = _u32(i * size1 + j), _u32(min(size1 - 1, 1))
    c = _u32(a + _u32(size1 * min(size0 - 1, 1)))
    return a, c, _u32(a + b), _u32(c + b)


@inlined
def _locate_1(x, first, count, size0, entries, weights):
    step = _u32(min(size0 - 1, 1))
    for number in range(count):
        n = index(number)
        i, f = axis_cell(x[first + n], size0 - 1)
        entries[n], entries[n + index(BLOCK)] = i, _u32(i + step)
        weights[n], weights[n + index(BLOCK)] = ONE - f, f


@inlined
def _locate_2(x, y, first, count, size0, size1, entries, weights):
    for number in range(count):
        n = index(number)
        i, f = axis_cell(x[first + n], size0 - 1)
        j, g = axis_cell(y[first + n], size1 - 1)
        _keep(entries, n, _rows_2(i, j, size0, size1), 4)
        p, q = ONE - f, ONE - g
        _keep(weights, n, (p * q, f * q, p * g, f * g), 4)


@inlined
def _locate_3(axes, first, count, sizes, entries, weights):
    x, y, z = axes
    size0, size1, size2 = sizes
    step = _u32(min(size2 - 1, 1))
    for number in range(count):
        n = index(number)
        i, f = axis_cell(x[first + n], size0 - 1)
        j, g = axis_cell(y[first + n], size1 - 1)
        k, h = axis_cell(z[first + n], size2 - 1)
        a, b, c, d = _rows_2(i, j, size0, size1)
        a, b, c, d = _u32(a * size2 + k), _u32(b * size2 + k), _u32(c * size2 + k), _u32(d * size2 + k)
        rows = a, b, c, d, _u32(a + step), _u32(b + step), _u32(c + step), _u32(d + step)
        _keep(entries, n, rows, 8)
        _keep(weights, n, trilinear_weights((f, g, h)), 8)


@inlined
def locate_block(positions, block, lattice, entries, weights):
    """Rows and weights of the corners around the points of a block: corner-major, `BLOCK` points each.

    ``positions`` is (3, m), ``block`` the first point and the number of points. The lattice's first axis varies fastest among
    corners, its last one among rows.
    """
    first, count = block
    x, y, z = positions[lattice.axis0], positions[lattice.axis1], positions[lattice.axis2]
    sizes = lattice.size0, lattice.size1, lattice.size2
    if lattice.corners == 8:
        _locate_3((x, y, z), first, count, sizes, entries, weights)
    elif lattice.corners == 4:
        _locate_2(x, y, first, count, sizes[0], sizes[1], entries, weights)
    else:
        _locate_1(x, first, count, sizes[0], entries, weights)
    if lattice.links != 0:
        links = words_at(lattice.links, sizes[0] * sizes[1] * sizes[2])
        most = lattice.rows
        for corner in range(lattice.corners):
            for number in range(count):
                n = index(corner * BLOCK) + index(number)
                row = np.int64(links[index(entries[n])])
                entries[n] = _u32(row) if 0 <= row < most else EMPTY


@inlined
def _interpolate(features, corners, entries, weights, n, channels, k, part):
    """Interpolate features k, k + 1, ... of the n-th point; ``part`` of them, if that is less than `LANES`."""
    total = broadcast(ZERO)
    for corner in range(corners):
        at = index(corner * BLOCK) + n
        if entries[at] != EMPTY:
            place = index(entries[at]) * channels + k
            values = load(features, place) if part == LANES else load_first(features, place, part)
            total = total + weights[at] * values
    return total


@inlined
def combine_into(out, at, part, mode, value):
    """Write, add or multiply the first lanes to the output."""
    if mode == ADD:
        value = value + (load(out, at) if part == LANES else load_first(out, at, part))
    elif mode == MULTIPLY:
        value = value * (load(out, at) if part == LANES else load_first(out, at, part))
    if part == LANES:
        store(out, at, value)
    else:
        store_first(out, at, part, value)


@inlined
def encode_block(positions, block, lattice, entries, weights, out, target):
    """Interpolate one lattice at the points of a block, into ``out`` from row ``target`` on.

    Args:
        positions: float32 (3, m) in the unit cube; clamped, NaN counts as 0.
        block: first point and number of points, at most `BLOCK`.
        lattice: a `RECORD`, whose ``column`` and ``mode`` say where the features go.
        entries: uint32 scratch of `CORNERS` x `BLOCK`.
        weights: float32 scratch of that size.
        out: contiguous float32 (points, width).
        target: row of ``out`` of the block's first point (uint64).
    """
    locate_block(positions, block, lattice, entries, weights)
    channels, corners, mode = index(lattice.channels), lattice.corners, lattice.mode
    features, width, column = floats_at(lattice.features, lattice.rows * lattice.channels), index(out.shape[1]), lattice.column
    whole, rest = channels // LANES * LANES, channels % LANES
    for number in range(block[1]):
        n = index(number)
        at = (target + n) * width + index(column)
        for start in range(0, whole, LANES):
            k = index(start)
            combine_into(out, at + k, LANES, mode, _interpolate(features, corners, entries, weights, n, channels, k, LANES))
        if rest > 0:
            value = _interpolate(features, corners, entries, weights, n, channels, whole, rest)
            combine_into(out, at + whole, rest, mode, value)
