"""Position derivatives of the hash encoding: vector-Jacobian product, Jacobian-vector product, and the latter's backward."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import CHUNK, ONE, ZERO, cell_corners, feature_rows, interpolate, scatter_add
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
def _vertex_values(table, r, k):
    return (
        table[r[0] + k], table[r[1] + k], table[r[2] + k], table[r[3] + k],
        table[r[4] + k], table[r[5] + k], table[r[6] + k], table[r[7] + k],
    )  # fmt: skip


@parallel
def position_gradient(unit, table, gradient, width, cells, offsets, masks, jobs, grad_unit):
    """Gradient of the positions (vector-Jacobian product); zero on axes on which a position was clamped."""
    for job in prange(jobs):
        begin, end = job_start(len(unit), jobs, job), job_start(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            grad_unit[chunk : min(chunk + CHUNK, end)] = ZERO
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                scale, column = np.float32(edge), index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = cell_corners(unit[i], edge, mask)
                    r = feature_rows(entries, offset, width)
                    for feature in range(width):
                        k = index(feature)
                        x, y, z = trilinear_gradient(_vertex_values(table, r, k), f)
                        g = gradient[i, column + k] * scale
                        grad_unit[i, 0] += g * x
                        grad_unit[i, 1] += g * y
                        grad_unit[i, 2] += g * z
            for number in range(chunk, min(chunk + CHUNK, end)):
                for a in range(3):
                    coordinate = unit[number, a]
                    if not (coordinate >= ZERO and coordinate <= ONE):
                        grad_unit[number, a] = ZERO


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
def encode_jvp(unit, table, along, width, cells, offsets, masks, jobs, out):
    """Jacobian-vector product of the encoding: derivative of all features in the direction ``along`` of each point."""
    for job in prange(jobs):
        begin, end = job_start(len(unit), jobs, job), job_start(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                column = index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = cell_corners(unit[i], edge, mask)
                    w, r = weights_jvp(f, along[i], np.float32(edge)), feature_rows(entries, offset, width)
                    for feature in range(width):
                        k = index(feature)
                        out[i, column + k] = interpolate(table, r, w, k)


@parallel
def encode_jvp_backward(unit, gradient, along, width, cells, offsets, masks, jobs, grad_table):
    """Gradient of the table through `encode_jvp`, whose cotangent is ``gradient``; jobs own levels as in `encode_backward`."""
    for job in prange(jobs):
        for level in range(job, len(cells), jobs):
            offset, mask, edge = index(offsets[level]), masks[level], cells[level]
            column = index(level) * width
            grad_table[offset * width : index(offsets[level + 1]) * width] = ZERO
            for number in range(len(unit)):
                i = index(number)
                entries, f = cell_corners(unit[i], edge, mask)
                w, r = weights_jvp(f, along[i], np.float32(edge)), feature_rows(entries, offset, width)
                for feature in range(width):
                    k = index(feature)
                    scatter_add(grad_table, r, w, k, gradient[i, column + k])
