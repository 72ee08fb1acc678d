"""Pairs of rays and Gaussians: rays of one origin are binned in a tangent plane, in which Gaussians have bounding boxes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.runtime import array, inlined, job_start, parallel, prange, scratch, serial, threads
from invgraphics.kernels.reference.gaussian_rays import MAX_DEVIATIONS, Primitives

RAYS_PER_CELL = 8
"""Rays of a cell of the tangent plane, on average."""
STEEPEST = 0.2
"""Least cosine between a ray and the mean of its group for which there is a tangent plane; other groups test all pairs."""
_EIGHT, _ONE = np.float32(MAX_DEVIATIONS), np.float32(1.0)
_ROUNDING = np.float32(4e-7)  # of a difference of two products, in units of either


@inlined
def restrict(table, g, ox, oy, oz, dx, dy, dz):
    """Restrict a Gaussian, whose row holds centre and whitening, to a ray.

    Returns distance of the peak, 1 / sigma², squared distance from the centre in standard deviations, and the whitened offset
    and direction.
    """
    cx, cy, cz = table[g, 0] - ox, table[g, 1] - oy, table[g, 2] - oz
    x0 = table[g, 3] * cx + table[g, 4] * cy + table[g, 5] * cz
    x1 = table[g, 6] * cx + table[g, 7] * cy + table[g, 8] * cz
    x2 = table[g, 9] * cx + table[g, 10] * cy + table[g, 11] * cz
    d0 = table[g, 3] * dx + table[g, 4] * dy + table[g, 5] * dz
    d1 = table[g, 6] * dx + table[g, 7] * dy + table[g, 8] * dz
    d2 = table[g, 9] * dx + table[g, 10] * dy + table[g, 11] * dz
    rate = d0 * d0 + d1 * d1 + d2 * d2
    t = (x0 * d0 + x1 * d1 + x2 * d2) / rate
    y0, y1, y2 = x0 - t * d0, x1 - t * d1, x2 - t * d2
    return t, rate, y0 * y0 + y1 * y1 + y2 * y2, (x0, x1, x2), (d0, d1, d2)


@inlined
def _bound(a, b, c):
    """Roots of ``a x² - 2 b x + c``, a > 0: bounds of the projection on one axis, widened for rounding.

    Of a Gaussian that is small beside its distance, ``b² - a c`` is what rounding leaves of two numbers that are nearly equal.
    """
    root = np.sqrt(max(b * b - a * c, np.float32(0.0)) + _ROUNDING * b * b) * np.float32(1.0001)
    return (b - root) / a - np.float32(1e-6), (b + root) / a + np.float32(1e-6)


@parallel
def bound_gaussians(table, reach, origin, axes, jobs, boxes):
    """Bounding boxes (x from, x to, y from, y to) in the tangent plane z = 1 of the axes' frame; x from > x to for none.

    The bounds of x / z over an ellipsoid of centre c and half-axes A are the roots of
    ``(cz² - |Az|²) x² - 2 (cx cz - Ax.Az) x + (cx² - |Ax|²) = 0``.
    """
    n = len(table)
    for job in prange(jobs):
        for g in range(job_start(n, jobs, job), job_start(n, jobs, job + 1)):
            boxes[g, 0], boxes[g, 1] = np.float32(1.0), np.float32(-1.0)
            if not reach[g] > 0:
                continue
            c0, c1, c2 = table[g, 0] - origin[0], table[g, 1] - origin[1], table[g, 2] - origin[2]
            cx = axes[0, 0] * c0 + axes[0, 1] * c1 + axes[0, 2] * c2
            cy = axes[1, 0] * c0 + axes[1, 1] * c1 + axes[1, 2] * c2
            cz = axes[2, 0] * c0 + axes[2, 1] * c1 + axes[2, 2] * c2
            xx, yy, zz, xz, yz = cx * cx, cy * cy, cz * cz, cx * cz, cy * cz
            squared = reach[g] * reach[g]
            depth = np.float32(0.0)
            for k in range(3):
                w0, w1, w2 = table[g, 3 + 3 * k], table[g, 4 + 3 * k], table[g, 5 + 3 * k]
                norm = w0 * w0 + w1 * w1 + w2 * w2
                # The half-axis is w / |w|² times the reach.
                scale = squared / (norm * norm)
                ax = axes[0, 0] * w0 + axes[0, 1] * w1 + axes[0, 2] * w2
                ay = axes[1, 0] * w0 + axes[1, 1] * w1 + axes[1, 2] * w2
                az = axes[2, 0] * w0 + axes[2, 1] * w1 + axes[2, 2] * w2
                xx -= scale * ax * ax
                yy -= scale * ay * ay
                zz -= scale * az * az
                xz -= scale * ax * az
                yz -= scale * ay * az
                depth += scale * az * az
            if zz > np.float32(1e-6) * cz * cz and cz > 0:
                boxes[g, 0], boxes[g, 1] = _bound(zz, xz, xx)
                boxes[g, 2], boxes[g, 3] = _bound(zz, yz, yy)
            elif cz > 0 or cz * cz < np.float32(1.01) * (_EIGHT * _EIGHT / squared + _ONE) * depth:
                # It reaches the camera's plane, within its reach or at `MAX_DEVIATIONS` along a ray.
                boxes[g, 0], boxes[g, 1] = np.float32(-np.inf), np.float32(np.inf)
                boxes[g, 2], boxes[g, 3] = np.float32(-np.inf), np.float32(np.inf)


@inlined
def _cells(low, high, begin, inverse, count):
    """First and last cell of an interval on one axis; empty if first > last."""
    first = max(np.floor((low - begin) * inverse), np.float32(0.0))
    last = min(np.floor((high - begin) * inverse), np.float32(count - 1))
    if first <= last:
        return np.int64(first), np.int64(last)
    return np.int64(1), np.int64(0)


@serial
def bin_rays(x, y, lo, inverse, shape, cell, first, order, sums):
    """Counting sort of rays by cell, rows of y first; ``sums`` gets the number of rays before each column and row."""
    cells = shape[0] * shape[1]
    first[: cells + 1] = 0
    for i in range(len(x)):
        column = min(np.int64((x[i] - lo[0]) * inverse[0]), shape[0] - 1)
        row = min(np.int64((y[i] - lo[1]) * inverse[1]), shape[1] - 1)
        cell[i] = row * shape[0] + column
        first[cell[i] + 1] += 1
    for c in range(cells):
        first[c + 1] += first[c]
    for i in range(len(x) - 1, -1, -1):
        c = cell[i] + 1
        first[c] -= 1
        order[first[c]] = i
    for c in range(cells):
        first[c] = first[c + 1]
    first[cells] = len(x)
    for row in range(shape[1]):
        for column in range(shape[0]):
            c = row * shape[0] + column
            above = sums[row, column + 1] + sums[row + 1, column] - sums[row, column]
            sums[row + 1, column + 1] = above + first[c + 1] - first[c]


@parallel
def count_tests(boxes, lo, inverse, shape, sums, rows, tests):
    """Number of pairs that each job, which has some rows of cells, will test."""
    for job in prange(len(tests)):
        total = 0
        for g in range(len(boxes)):
            if boxes[g, 0] <= boxes[g, 1]:
                left, right = _cells(boxes[g, 0], boxes[g, 1], lo[0], inverse[0], shape[0])
                top, bottom = _cells(boxes[g, 2], boxes[g, 3], lo[1], inverse[1], shape[1])
                top, bottom = max(top, rows[job]), min(bottom, rows[job + 1] - 1)
                if left <= right and top <= bottom:
                    total += sums[bottom + 1, right + 1] - sums[top, right + 1] - sums[bottom + 1, left] + sums[top, left]
        tests[job] = total


@parallel
def find_pairs(boxes, table, reach, grid, rows, rays, begin, counts, found, numbers):
    """Test the pairs of each job's cells; ``found`` gets (ray, Gaussian), by Gaussian in a job, ``counts`` those of a ray."""
    lo, inverse, shape, first, order = grid
    origin, directions, near, far = rays
    for job in prange(len(numbers)):
        at = begin[job]
        for g in range(len(boxes)):
            if boxes[g, 0] <= boxes[g, 1]:
                limit = reach[g] * reach[g]
                left, right = _cells(boxes[g, 0], boxes[g, 1], lo[0], inverse[0], shape[0])
                top, bottom = _cells(boxes[g, 2], boxes[g, 3], lo[1], inverse[1], shape[1])
                for row in range(max(top, rows[job]), min(bottom, rows[job + 1] - 1) + 1):
                    for k in range(first[row * shape[0] + left], first[row * shape[0] + right + 1] if left <= right else 0):
                        r = order[k]
                        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
                        t, rate, squared, _, _ = restrict(table, g, origin[0], origin[1], origin[2], dx, dy, dz)
                        extent = _EIGHT / np.sqrt(rate)
                        if squared < limit and t + extent > near[r] and t - extent < far[r]:
                            found[at, 0], found[at, 1] = r, g
                            counts[r] += 1
                            at += 1
        numbers[job] = at - begin[job]


@serial
def sort_by_ray(found, begin, numbers, cursors, ray, gaussian):
    """Scatter pairs to their rays; ``cursors`` holds the place of each ray's next one."""
    for job in range(len(numbers)):
        for k in range(begin[job], begin[job] + numbers[job]):
            r = found[k, 0]
            place = cursors[r]
            cursors[r] = place + 1
            ray[place], gaussian[place] = r, found[k, 1]


def gaussian_pairs(primitives: Primitives, rays: Rays) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """See `invgraphics.kernels.reference.gaussian_rays.gaussian_pairs`."""
    table = array(torch.cat([primitives.means.detach(), primitives.whitening.detach().flatten(1)], dim=1))
    reach = array(primitives.reach)
    origins = rays.origins.detach()
    new = torch.ones(len(rays), dtype=torch.bool)
    new[1:] = (origins[1:] != origins[:-1]).any(dim=1)
    limits = [*new.nonzero()[:, 0].tolist(), len(rays)]
    found = [np.empty((2, 0), np.int64)]
    for first, end in pairwise(limits):
        pairs = _of_one_origin(table, reach, rays[first:end])
        pairs[0] += first
        found.append(pairs)
    ray, gaussian = torch.from_numpy(np.concatenate(found, axis=1))
    return ray, gaussian


def _of_one_origin(table: np.ndarray, reach: np.ndarray, rays: Rays) -> np.ndarray:
    """Pairs (2, p) of rays with one origin, by ray, then by Gaussian."""
    directions, origin, jobs = rays.directions.detach(), array(rays.origins[0]), threads()
    axis = torch.nn.functional.normalize(directions.mean(dim=0), dim=0)
    side = torch.zeros(3)
    side[int(axis.abs().argmin())] = 1.0
    across = torch.nn.functional.normalize(torch.linalg.cross(axis, side), dim=0)
    axes = torch.stack([across, torch.linalg.cross(axis, across), axis])
    x, y, z = (directions @ axes.T).unbind(dim=1)
    boxes = scratch("gaussians.boxes", 4 * len(table)).reshape(-1, 4)[: len(table)]
    if bool(z.min() > STEEPEST):
        x, y = x / z, y / z
        bound_gaussians(table, reach, origin, axes.numpy(), jobs, boxes)
    else:
        x, y = torch.zeros_like(z), torch.zeros_like(z)
        boxes[:] = np.where(reach > 0, 1.0, np.nan)[:, None] * np.array([-np.inf, np.inf] * 2)
    grid, sums = _grid(x, y)
    shape = grid[2]
    rows = np.searchsorted(sums[:, -1], np.arange(jobs + 1) * len(z) / jobs).astype(np.int64)
    rows[0], rows[-1] = 0, shape[1]
    tests = np.empty(jobs, np.int64)
    count_tests(boxes, *grid[:3], sums, rows, tests)
    begin = np.cumsum(tests) - tests
    pairs = scratch("gaussians.pairs", 2 * int(tests.sum()), np.int32).reshape(-1, 2)
    counts, numbers = np.zeros(len(z), np.int64), np.empty(jobs, np.int64)
    given = origin, array(directions), array(rays.near), array(rays.far)
    find_pairs(boxes, table, reach, grid, rows, given, begin, counts, pairs, numbers)
    result = np.empty((2, int(numbers.sum())), np.int64)
    sort_by_ray(pairs, begin, numbers, np.cumsum(counts) - counts, result[0], result[1])
    return result


def _grid(x: Tensor, y: Tensor) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Cells of the tangent plane: (lowest corner, cells per length, shape, first ray of each cell, rays), and sums of rays."""
    lo = np.array([float(x.min()), float(y.min())], np.float32)
    size = np.array([float(x.max()), float(y.max())], np.float32) - lo
    edges = max(1, round((len(x) / RAYS_PER_CELL) ** 0.5))
    shape = np.where(size > 0, edges, 1).astype(np.int64)
    inverse = (shape / np.maximum(size, np.float32(1e-12)) * (1 - 1e-6)).astype(np.float32)
    first, order = np.empty(int(shape.prod()) + 1, np.int64), np.empty(len(x), np.int64)
    sums = np.zeros((int(shape[1]) + 1, int(shape[0]) + 1), np.int64)
    bin_rays(array(x), array(y), lo, inverse, shape, np.empty(len(x), np.int64), first, order, sums)
    return (lo, inverse, shape, first, order), sums
