"""Derivatives of the hash encoding along positions, and what a loss on those needs."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import CHUNK, ONE, ZERO, blend, corners, rows_of, spread
from invgraphics.kernels.numba.runtime import index, inlined, parallel, prange, share


@inlined
def slopes(v, f):
    """Derivatives along the fractions of the trilinear interpolant of the 8 values ``v``."""
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
def locate_back(unit, table, gradient, width, cells, offsets, masks, jobs, to_unit):
    """Gradient along the positions; zero along the axes on which a position was clamped."""
    for job in prange(jobs):
        begin, end = share(len(unit), jobs, job), share(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            to_unit[chunk : min(chunk + CHUNK, end)] = ZERO
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                scale, column = np.float32(edge), index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = corners(unit[i], edge, mask)
                    r = rows_of(entries, offset, width)
                    for feature in range(width):
                        k = index(feature)
                        x, y, z = slopes(_vertex_values(table, r, k), f)
                        g = gradient[i, column + k] * scale
                        to_unit[i, 0] += g * x
                        to_unit[i, 1] += g * y
                        to_unit[i, 2] += g * z
            for number in range(chunk, min(chunk + CHUNK, end)):
                for a in range(3):
                    coordinate = unit[number, a]
                    if not (coordinate >= ZERO and coordinate <= ONE):
                        to_unit[number, a] = ZERO


@inlined
def rise_of(f, v, scale):
    """Derivatives of the trilinear weights in the direction ``v``: `weights_of`, differentiated."""
    x, y, z = f
    p, q, r = ONE - x, ONE - y, ONE - z
    along_x, along_y, along_z = v[0] * scale, v[1] * scale, v[2] * scale
    a, b, c, d = along_x * q * r, along_x * y * r, along_x * q * z, along_x * y * z
    low, high = along_y * r, along_y * z
    i, j, k, l = -low - along_z * q, low - along_z * y, along_z * q - high, high + along_z * y  # noqa: E741
    return p * i - a, x * i + a, p * j - b, x * j + b, p * k - c, x * k + c, p * l - d, x * l + d


@parallel
def rise(unit, table, along, width, cells, offsets, masks, jobs, out):
    """Derivative of all levels' features in the direction ``along`` of each point."""
    for job in prange(jobs):
        begin, end = share(len(unit), jobs, job), share(len(unit), jobs, job + 1)
        for chunk in range(begin, end, CHUNK):
            for level in range(len(cells)):
                offset, mask, edge = index(offsets[level]), masks[level], cells[level]
                column = index(level) * width
                for number in range(chunk, min(chunk + CHUNK, end)):
                    i = index(number)
                    entries, f = corners(unit[i], edge, mask)
                    w, r = rise_of(f, along[i], np.float32(edge)), rows_of(entries, offset, width)
                    for feature in range(width):
                        k = index(feature)
                        out[i, column + k] = blend(table, r, w, k)


@parallel
def rise_back(unit, gradient, along, width, cells, offsets, masks, jobs, to_table):
    """Gradient along the table of `rise`, for which ``gradient`` is the cotangent; levels are shared as in `encode_back`."""
    for job in prange(jobs):
        for level in range(job, len(cells), jobs):
            offset, mask, edge = index(offsets[level]), masks[level], cells[level]
            column = index(level) * width
            to_table[offset * width : index(offsets[level + 1]) * width] = ZERO
            for number in range(len(unit)):
                i = index(number)
                entries, f = corners(unit[i], edge, mask)
                w, r = rise_of(f, along[i], np.float32(edge)), rows_of(entries, offset, width)
                for feature in range(width):
                    k = index(feature)
                    spread(to_table, r, w, k, gradient[i, column + k])
