"""Gradient of the lattice encoding in the positions."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import ONE, ZERO, axis_cell
from invgraphics.kernels.numba.hash.jacobian import trilinear_gradient
from invgraphics.kernels.numba.lattice.backward import gradient_of, interpolate_group, list_points
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, EMPTY, corners_of, job_scratch, locate_block
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, job_start, parallel, prange
from invgraphics.kernels.numba.simd.lanes import broadcast, load, reduce_sums, store
from invgraphics.kernels.numba.simd.partial import floats_at, load_first, unowned


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


@inlined
def _add_block(positions, block, lattice, entries, source, sums, grad_unit):
    """Add what one lattice contributes at a block's points."""
    gradient, place, stride = source
    features = floats_at(lattice.features, lattice.rows * lattice.channels)
    sums[:] = ZERO
    for point in range(block[1]):
        n = index(point)
        i = block[0] + n
        _dot_products(features, gradient, place + n * stride, entries, n, lattice, sums)
        x, y, z = index(lattice.axis0), index(lattice.axis1), index(lattice.axis2)
        f, a = _axis(positions[x, i], lattice.size0)
        g, b = _axis(positions[y, i], lattice.size1)
        h, c = _axis(positions[z, i], lattice.size2)
        v = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
        along_x, along_y, along_z = trilinear_gradient(v, (f, g, h))
        grad_unit[x, i] += a * along_x
        grad_unit[y, i] += b * along_y
        grad_unit[z, i] += c * along_z


@parallel
def position_gradient(positions, gradient, lattices, memory, sizes, jobs, grad_unit):
    """Gradient of the positions (3, m); zero on axes on which a position was clamped."""
    points = positions.shape[1]
    for job in prange(jobs):
        scratch, sums = job_scratch(memory, sizes, job), np.empty(CORNERS * GROUP, np.float32)
        received, chosen = (unowned(gradient), index(gradient.shape[1])), scratch[3]
        begin, end = job_start(points, jobs, job), job_start(points, jobs, job + 1)
        grad_unit[:, begin:end] = ZERO
        for start in range(begin, end, BLOCK):
            block = index(start), min(BLOCK, end - start)
            some = chosen, list_points(block[1], chosen)
            for number in range(len(lattices)):
                lattice = lattices[number]
                first, last = lattice.group, lattice.group_end
                if number == first:
                    for other in range(first, last):
                        entries, weights = corners_of(scratch, other - first)
                        locate_block(positions, block, lattices[other], entries, weights)
                    if last - first > 1:
                        interpolate_group(lattices, first, last, some, scratch)
                source = gradient_of(received, block, lattices, number, some, scratch)
                _add_block(positions, block, lattice, corners_of(scratch, number - first)[0], source, sums, grad_unit)
