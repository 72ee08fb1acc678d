"""Gradients of the lattice encoding: of the factors of a product, of features, and of positions.

``gradient`` is always contiguous float32 (m, total), in which the gradient of a lattice's own interpolated features begins at
its record's ``column``.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import ONE, ZERO, axis_cell
from invgraphics.kernels.numba.hash.jacobian import trilinear_gradient
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, EMPTY, encode_block, locate_block
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, job_start, parallel, prange, serial
from invgraphics.kernels.numba.simd.lanes import broadcast, load, reduce_sums, store
from invgraphics.kernels.numba.simd.partial import floats_at, load_first, store_first

SAMPLE = 61
"""Every so many-th point tells where on a lattice the work lies: a prime, so that it keeps step with no number of samples."""


@inlined
def _factor_gradient(gradient, place, values, n, number, separate, out, at):
    """Gradient of one factor at one point: that of the product times the values of its other factors."""
    channels, width = index(separate[number].channels), index(values.shape[1])
    for start in range(0, channels, LANES):
        k = index(start)
        part = min(channels - k, LANES)
        total = load_first(gradient, place + k, part)
        for other in range(separate[number].group, separate[number].group_end):
            if other != number:
                total = total * load_first(values, n * width + index(separate[other].column) + k, part)
        store_first(out, at + k, part, total)


@parallel
def factor_gradients(positions, gradient, combined, separate, jobs, out):
    """Gradients of every lattice's interpolated features through the products that ``combined`` describes.

    ``separate`` holds the same lattices, their features one after the other; the result is laid out as it says.
    """
    points, width = positions.shape[1], out.shape[1]
    for job in prange(jobs):
        entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
        values = np.empty((BLOCK, width), np.float32)
        begin, end = job_start(points, jobs, job), job_start(points, jobs, job + 1)
        for first in range(begin, end, BLOCK):
            count = min(BLOCK, end - first)
            for number in range(len(separate)):
                encode_block(positions, (index(first), count), separate[number], entries, weights, values, index(0))
            for point in range(count):
                n = index(point)
                i = index(first) + n
                for number in range(len(separate)):
                    place = i * index(gradient.shape[1]) + index(combined[number].column)
                    at = i * index(width) + index(separate[number].column)
                    _factor_gradient(gradient, place, values, n, number, separate, out, at)


@serial
def sample_rows(positions, lattices, rows):
    """Row of the first corner of every `SAMPLE`-th point, per lattice: (lattices, samples), uint32."""
    entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
    for number in range(len(lattices)):
        for sample in range(rows.shape[1]):
            locate_block(positions, (index(sample * SAMPLE), 1), lattices[number], entries, weights)
            rows[number, sample] = entries[0]


def split_rows(positions: np.ndarray, lattices: np.ndarray, jobs: int) -> np.ndarray:
    """Partition of every lattice's rows into ranges that about as many points read; (lattices, jobs + 1)."""
    samples = -(-positions.shape[1] // SAMPLE)
    starts = np.zeros((len(lattices), jobs + 1), np.int64)
    starts[:, -1] = lattices["rows"]
    if samples:
        rows = np.empty((len(lattices), samples), np.uint32)
        sample_rows(positions, lattices, rows)
        rows.sort(axis=1)
        starts[:, 1:-1] = np.minimum(rows[:, [samples * job // jobs for job in range(1, jobs)]], lattices["rows"][:, None])
    return starts


@inlined
def _add_to_row(grad_rows, at, weight, gradient, place, channels):
    """Add a weighted gradient to a row of features."""
    whole, rest = channels // LANES * LANES, channels % LANES
    for start in range(0, whole, LANES):
        k = index(start)
        store(grad_rows, at + k, load(grad_rows, at + k) + weight * load(gradient, place + k))
    if rest > 0:
        old, new = load_first(grad_rows, at + whole, rest), load_first(gradient, place + whole, rest)
        store_first(grad_rows, at + whole, rest, old + weight * new)


@inlined
def _scatter_block(gradient, block, lattice, entries, weights, owned, grad_rows):
    """Add the gradients of a block's points to the ``owned`` rows among those of their corners."""
    start, end = owned
    channels, width, column = index(lattice.channels), index(gradient.shape[1]), index(lattice.column)
    corners, dense = lattice.corners, lattice.links == 0
    last = index((corners - 1) * BLOCK)
    for number in range(block[1]):
        n = index(number)
        # Rows of a dense cell lie between those of its first and last corner.
        if not (dense and (entries[n] >= end or entries[last + n] < start)):
            place = (block[0] + n) * width + column
            for corner in range(corners):
                at = index(corner * BLOCK) + n
                row = entries[at]
                if row >= start and row < end:
                    _add_to_row(grad_rows, index(row) * channels, weights[at], gradient, place, channels)


@parallel
def feature_gradients(positions, gradient, lattices, starts, targets, jobs):
    """Gradients of all lattices' features, at the addresses ``targets``.

    Each job owns a range of each lattice's rows, ``starts``, and adds to them in the order of the points: no row is written by
    two jobs, and sums are the same for any number of them.
    """
    points = positions.shape[1]
    for job in prange(jobs):
        entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
        for number in range(len(lattices)):
            lattice = lattices[number]
            grad_rows = floats_at(targets[number], lattice.rows * lattice.channels)
            start, end = starts[number, job], starts[number, job + 1]
            grad_rows[start * lattice.channels : end * lattice.channels] = ZERO
            if start < end:
                for first in range(0, points, BLOCK):
                    block = index(first), min(BLOCK, points - first)
                    locate_block(positions, block, lattice, entries, weights)
                    _scatter_block(gradient, block, lattice, entries, weights, (start, end), grad_rows)


@inlined
def _dot_products(features, gradient, place, entries, n, lattice, sums):
    """Products of a gradient with the features of the 8 corners, in the first values of ``sums``."""
    channels = index(lattice.channels)
    whole, rest = channels // LANES * LANES, channels % LANES
    for corner in range(lattice.corners):
        row, total = entries[index(corner * BLOCK) + n], broadcast(ZERO)
        if row != EMPTY:
            at = index(row) * channels
            for start in range(0, whole, LANES):
                k = index(start)
                total = total + load(features, at + k) * load(gradient, place + k)
            if rest > 0:
                total = total + load_first(features, at + whole, rest) * load_first(gradient, place + whole, rest)
        store(sums, index(corner) * LANES, total)
    parts = (
        load(sums, index(0)), load(sums, LANES), load(sums, index(2) * LANES), load(sums, index(3) * LANES),
        load(sums, index(4) * LANES), load(sums, index(5) * LANES), load(sums, index(6) * LANES), load(sums, index(7) * LANES),
    )  # fmt: skip
    store(sums, index(0), reduce_sums(parts))


@inlined
def _axis(coordinate, size):
    """Fraction within a cell, and cells along the axis, 0 where the position was clamped."""
    _, fraction = axis_cell(coordinate, size - 1)
    return fraction, np.float32(size - 1) if coordinate >= ZERO and coordinate <= ONE else ZERO


@parallel
def position_gradient(positions, gradient, lattices, jobs, grad_unit):
    """Gradient of the positions (3, m); zero on axes on which a position was clamped."""
    points, width = positions.shape[1], index(gradient.shape[1])
    for job in prange(jobs):
        entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
        sums = np.empty(CORNERS * GROUP, np.float32)
        begin, end = job_start(points, jobs, job), job_start(points, jobs, job + 1)
        grad_unit[:, begin:end] = ZERO
        for first in range(begin, end, BLOCK):
            block = index(first), min(BLOCK, end - first)
            for number in range(len(lattices)):
                lattice = lattices[number]
                locate_block(positions, block, lattice, entries, weights)
                features = floats_at(lattice.features, lattice.rows * lattice.channels)
                sums[:] = ZERO
                for point in range(block[1]):
                    n = index(point)
                    i = block[0] + n
                    _dot_products(features, gradient, i * width + index(lattice.column), entries, n, lattice, sums)
                    x, y, z = index(lattice.axis0), index(lattice.axis1), index(lattice.axis2)
                    f, a = _axis(positions[x, i], lattice.size0)
                    g, b = _axis(positions[y, i], lattice.size1)
                    h, c = _axis(positions[z, i], lattice.size2)
                    v = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
                    along_x, along_y, along_z = trilinear_gradient(v, (f, g, h))
                    grad_unit[x, i] += a * along_x
                    grad_unit[y, i] += b * along_y
                    grad_unit[z, i] += c * along_z
