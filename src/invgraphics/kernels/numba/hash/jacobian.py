"""Position derivatives of the hash encoding: vector-Jacobian product, Jacobian-vector product, and the latter's backward."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.blocks import TWO, block_at, dot_block, gather_block, locate_fractions, scatter_block
from invgraphics.kernels.numba.hash.cells import BLOCK, CHUNK, ONE, ZERO, load_corners, prefetch_entries, store_corners
from invgraphics.kernels.numba.runtime import index, inlined, job_start, parallel, prange


@inlined
def trilinear_gradient(v, f):
    """Gradient of the trilinear interpolant of the 8 values ``v`` with respect to the fractions ``f``."""
    x, y, z = f
    p, q, r = ONE - x, ONE - y, ONE - z
    along_x = q * r * (v[1] - v[0]) + y * r * (v[3] - v[2]) + q * z * (v[5] - v[4]) + y * z * (v[7] - v[6])
    along_y = p * r * (v[2] - v[0]) + x * r * (v[3] - v[1]) + p * z * (v[6] - v[4]) + x * z * (v[7] - v[5])
    along_z = p * q * (v[4] - v[0]) + x * q * (v[5] - v[1]) + p * y * (v[6] - v[2]) + x * y * (v[7] - v[3])
    return along_x, along_y, along_z


@inlined
def mixed_derivatives(v, f):
    """Second derivatives (xy, xz, yz) of the trilinear interpolant of the 8 values ``v`` in the fractions ``f``."""
    x, y, z = f
    p, q, r = ONE - x, ONE - y, ONE - z
    xy = r * (v[0] - v[1] - v[2] + v[3]) + z * (v[4] - v[5] - v[6] + v[7])
    xz = q * (v[0] - v[1] - v[4] + v[5]) + y * (v[2] - v[3] - v[6] + v[7])
    yz = p * (v[0] - v[2] - v[4] + v[6]) + x * (v[1] - v[3] - v[5] + v[7])
    return xy, xz, yz


@inlined
def weights_jvp(f, v, scale):
    """Jacobian-vector product of `trilinear_weights`: derivatives of the weights in the direction ``v``."""
    x, y, z = f
    p, q, r = ONE - x, ONE - y, ONE - z
    along_x, along_y, along_z = v[0] * scale, v[1] * scale, v[2] * scale
    a, b, c, d = along_x * q * r, along_x * y * r, along_x * q * z, along_x * y * z
    low, high = along_y * r, along_y * z
    i, j, k, l = -low - along_z * q, low - along_z * y, along_z * q - high, high + along_z * y  # noqa: E741
    return p * i - a, x * i + a, p * j - b, x * j + b, p * k - c, x * k + c, p * l - d, x * l + d


@parallel
def position_gradient(positions, table, gradient, width, cells, offsets, masks, jobs, grad_positions):
    """Gradient of the positions (vector-Jacobian product); zero on axes on which a position was clamped.

    ``positions`` and ``grad_positions`` are (3, m), ``table`` is flat.
    """
    x, y, z = positions[0], positions[1], positions[2]
    for job in prange(jobs):
        entries, fractions = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 3, BLOCK), np.float32)
        products = np.empty(8 * BLOCK, np.float32)
        begin, end = job_start(len(x), jobs, job), job_start(len(x), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            until = min(chunk + CHUNK, end)
            grad_positions[:, chunk:until] = ZERO
            for number in range(len(cells)):
                level, column = (cells[number], offsets[number], masks[number]), index(number) * width
                # The next block's entries are prefetched, as in `encode`.
                for first in range(chunk, until + BLOCK, BLOCK):
                    if first < until:
                        block, place = block_at(first, until), first // BLOCK % 2
                        locate_fractions(x, y, z, block, level, entries[place], fractions[place])
                        if width == TWO:
                            prefetch_entries(table, entries[place], block[1])
                    if first > chunk:
                        block, place = block_at(first - BLOCK, until), (first // BLOCK - 1) % 2
                        dot_block(table, entries[place], gradient, block, column, width, products)
                        _add_gradient(products, fractions[place], block, np.float32(cells[number]), grad_positions)
            for axis in range(3):
                for number in range(chunk, until):
                    coordinate = positions[axis, number]
                    if not (coordinate >= ZERO and coordinate <= ONE):
                        grad_positions[axis, number] = ZERO


@inlined
def _add_gradient(products, fractions, block, scale, grad_positions):
    """Add a level's part of the gradients of a block's positions, from the `dot_block` of its corners."""
    first, count = block
    for number in range(count):
        n = index(number)
        f = fractions[0, n], fractions[1, n], fractions[2, n]
        along_x, along_y, along_z = trilinear_gradient(load_corners(products, n), f)
        grad_positions[0, first + n] += scale * along_x
        grad_positions[1, first + n] += scale * along_y
        grad_positions[2, first + n] += scale * along_z


@parallel
def hessian_product(positions, table, gradient, along, width, cells, offsets, masks, jobs, out):
    """Derivative of `position_gradient` along a direction ``along`` at each point, (3, m) like ``out``; clamping is ignored.

    Within a cell the features are trilinear: of the second derivatives only the mixed ones are not zero.
    """
    x, y, z = positions[0], positions[1], positions[2]
    for job in prange(jobs):
        entries, fractions = np.empty(8 * BLOCK, np.uint32), np.empty((3, BLOCK), np.float32)
        products = np.empty(8 * BLOCK, np.float32)
        begin, end = job_start(len(x), jobs, job), job_start(len(x), jobs, job + 1)
        out[:, begin:end] = ZERO
        for number in range(len(cells)):
            level, column = (cells[number], offsets[number], masks[number]), index(number) * width
            for start in range(begin, end, BLOCK):
                first, count = block_at(start, end)
                locate_fractions(x, y, z, (first, count), level, entries, fractions)
                dot_block(table, entries, gradient, (first, count), column, width, products)
                squared = np.float32(cells[number]) * np.float32(cells[number])
                for point in range(count):
                    n = index(point)
                    f = fractions[0, n], fractions[1, n], fractions[2, n]
                    xy, xz, yz = mixed_derivatives(load_corners(products, n), f)
                    a, b, c = along[0, first + n], along[1, first + n], along[2, first + n]
                    out[0, first + n] += squared * (xy * b + xz * c)
                    out[1, first + n] += squared * (xy * a + yz * c)
                    out[2, first + n] += squared * (xz * a + yz * b)


@inlined
def _locate_jvp(positions, along, block, level, buffers):
    """Entries of a block's corners, and the derivatives of their weights in each point's direction ``along``, (3, m)."""
    entries, fractions, weights = buffers
    first, count = block
    locate_fractions(positions[0], positions[1], positions[2], block, level, entries, fractions)
    a, b, c, scale = along[0], along[1], along[2], np.float32(level[0])
    for number in range(count):
        n = index(number)
        f = fractions[0, n], fractions[1, n], fractions[2, n]
        store_corners(weights, n, weights_jvp(f, (a[first + n], b[first + n], c[first + n]), scale))


@parallel
def encode_jvp(positions, table, along, width, cells, offsets, masks, jobs, out):
    """Jacobian-vector product of the encoding: derivative of all features in the direction ``along`` of each point."""
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        fractions = np.empty((3, BLOCK), np.float32)
        begin = job_start(positions.shape[1], jobs, job)
        end = job_start(positions.shape[1], jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            until = min(chunk + CHUNK, end)
            for number in range(len(cells)):
                level, column = (cells[number], offsets[number], masks[number]), index(number) * width
                for first in range(chunk, until + BLOCK, BLOCK):
                    if first < until:
                        block, place = block_at(first, until), first // BLOCK % 2
                        _locate_jvp(positions, along, block, level, (entries[place], fractions, weights[place]))
                        if width == TWO:
                            prefetch_entries(table, entries[place], block[1])
                    if first > chunk:
                        block, place = block_at(first - BLOCK, until), (first // BLOCK - 1) % 2
                        gather_block(table, entries[place], weights[place], block, column, width, out)


@parallel
def encode_jvp_backward(positions, gradient, along, width, cells, offsets, masks, jobs, grad_table):
    """Gradient of the table through `encode_jvp`, whose cotangent is ``gradient``; jobs own levels as in `encode_backward`."""
    for job in prange(jobs):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        fractions = np.empty((3, BLOCK), np.float32)
        for number in range(job, len(cells), jobs):
            level, column = (cells[number], offsets[number], masks[number]), index(number) * width
            grad_table[index(offsets[number]) * width : index(offsets[number + 1]) * width] = ZERO
            for first in range(0, positions.shape[1], BLOCK):
                block = block_at(first, positions.shape[1])
                _locate_jvp(positions, along, block, level, (entries, fractions, weights))
                scatter_block(gradient, entries, weights, block, column, width, grad_table)
