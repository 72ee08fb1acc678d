"""Lattices as kernels read them, and the corners of their cells around a block of points; inlined into the kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from invgraphics.core.lattice import Combination, Lattice
from invgraphics.kernels.numba.hash.cells import ONE, axis_cell, trilinear_weights
from invgraphics.kernels.numba.runtime import GROUP, index, inlined
from invgraphics.kernels.numba.simd.partial import floats_at, unsigned_at, words_at

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
            *("slot", "stride"),  # first value, and values per point, in a block's scratch of the group's features
        )
    ]
)
"""One lattice, as kernels read it."""

_u32 = np.uint32
_WORD = 4
"""Bytes of all numbers in a job's scratch."""


def padded(channels: int) -> int:
    """Channels, rounded up to whole registers."""
    return -(-channels // GROUP) * GROUP


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
        place["stride"] = padded(lattice.channels)
        place["slot"] = BLOCK * sum(padded(lattices[k].channels) for k in range(first, number))
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


def scratch_words(lattices: np.ndarray) -> tuple[int, int, int]:
    """Sizes of a job's scratch: most lattices of a group, most values of a group in a block, and most of a lattice."""
    groups = [lattices[first:end] for first, end in zip(lattices["group"], lattices["group_end"], strict=True)]
    values = max(int(group["stride"].sum()) for group in groups)
    return max(map(len, groups)), BLOCK * values, BLOCK * int(lattices["stride"].max())


def job_words(sizes: tuple[int, int, int]) -> int:
    """Words of each job's scratch (see `job_scratch`), in whole cache lines."""
    members, group_values, lattice_values = sizes
    return 2 * members * CORNERS * BLOCK + group_values + lattice_values + 2 * BLOCK


@inlined
def job_scratch(memory, sizes, job):
    """Scratch of a job, at an address: of corners, of a group's values, of a factor's gradient, and two lists of points."""
    members, group_values, lattice_values = sizes
    corners = 2 * members * CORNERS * BLOCK
    first = memory + _WORD * np.int64(job) * (corners + group_values + lattice_values + 2 * BLOCK)
    values = first + _WORD * corners
    factors = values + _WORD * group_values
    chosen = factors + _WORD * lattice_values
    lists = unsigned_at(chosen, BLOCK), unsigned_at(chosen + _WORD * BLOCK, BLOCK)
    return first, floats_at(values, group_values), floats_at(factors, lattice_values), lists[0], lists[1]


@inlined
def corners_of(scratch, member):
    """Rows and weights of the corners (see `locate_block`) of a group's ``member``."""
    first = scratch[0] + 2 * _WORD * CORNERS * BLOCK * member
    return unsigned_at(first, CORNERS * BLOCK), floats_at(first + _WORD * CORNERS * BLOCK, CORNERS * BLOCK)
