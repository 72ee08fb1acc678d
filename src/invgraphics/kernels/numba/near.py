"""Nearest points within a radius by cell lists: points are sorted into cells of one radius, a query looks at 27 of them."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.numba.runtime import array, exact, exact_parallel, job_start, prange, scratch, threads

MOST_CELLS = 1 << 22
"""Cells of the grid; a small radius gets larger cells instead of more."""


@exact
def _cell(x, lo, inverse, cells):
    """Index of a finite coordinate's cell, clamped to the grid, before the conversion: what int64 cannot hold is undefined."""
    return np.int64(min(max((x - lo) * inverse, 0.0), cells - 1.0))


@exact
def _cell_or_beyond(x, lo, inverse, cells):
    """Index of a coordinate's cell, -1 or ``cells`` if it is next to the grid; -2, whose neighbours are none, otherwise."""
    at = np.floor((x - lo) * inverse)
    return np.int64(at) if at >= -1.0 and at <= cells else np.int64(-2)


@exact_parallel
def fill_cells(points, lo, inverse, shape, jobs, cell, first, order):
    """Counting sort of points by cell: ``order[first[c] .. first[c + 1] - 1]`` are the points of cell c, by index."""
    n = len(points)
    for job in prange(jobs):
        for i in range(job_start(n, jobs, job), job_start(n, jobs, job + 1)):
            x = _cell(points[i, 0], lo[0], inverse, shape[0])
            y = _cell(points[i, 1], lo[1], inverse, shape[1])
            z = _cell(points[i, 2], lo[2], inverse, shape[2])
            cell[i] = (x * shape[1] + y) * shape[2] + z
    cells = shape[0] * shape[1] * shape[2]
    first[: cells + 1] = 0
    for i in range(n):
        first[cell[i] + 1] += 1
    for c in range(cells):
        first[c + 1] += first[c]
    for i in range(n - 1, -1, -1):
        # Backwards, from the end of each cell's range: indices ascend within it, and ``first`` is shifted by one cell.
        c = cell[i] + 1
        first[c] -= 1
        order[first[c]] = i
    for c in range(cells):
        first[c] = first[c + 1]
    first[cells] = n


@exact
def _insert(index, squared, kept, i, d):
    """Insert a neighbour in the order of distance, then index; returns the number kept, at most all places."""
    if kept == len(index):
        last = kept - 1
        if d > squared[last] or (d == squared[last] and i > index[last]):
            return kept
    else:
        last = kept
    while last > 0 and (squared[last - 1] > d or (squared[last - 1] == d and index[last - 1] > i)):
        squared[last], index[last] = squared[last - 1], index[last - 1]
        last -= 1
    squared[last], index[last] = d, i
    return min(kept + 1, len(index))


@exact_parallel
def find_near(position, points, lo, inverse, shape, first, order, limit, jobs, index, squared):
    """Neighbours of every position; ``index`` holds -1 and ``squared`` infinity before."""
    m = len(position)
    for job in prange(jobs):
        for q in range(job_start(m, jobs, job), job_start(m, jobs, job + 1)):
            px, py, pz = position[q, 0], position[q, 1], position[q, 2]
            cx = _cell_or_beyond(px, lo[0], inverse, shape[0])
            cy = _cell_or_beyond(py, lo[1], inverse, shape[1])
            cz = _cell_or_beyond(pz, lo[2], inverse, shape[2])
            z0, z1 = max(cz - 1, np.int64(0)), min(cz + 1, shape[2] - 1)
            kept = 0
            if z0 <= z1:
                for x in range(max(cx - 1, np.int64(0)), min(cx + 2, shape[0])):
                    for y in range(max(cy - 1, np.int64(0)), min(cy + 2, shape[1])):
                        row = (x * shape[1] + y) * shape[2]
                        # Cells along z are neighbours in memory: one range of points.
                        for k in range(first[row + z0], first[row + z1 + 1]):
                            i = order[k]
                            dx, dy, dz = px - points[i, 0], py - points[i, 1], pz - points[i, 2]
                            d = dx * dx + dy * dy + dz * dz
                            if d <= limit:
                                kept = _insert(index[q], squared[q], kept, i, d)


def near_points(
    position: Float[Tensor, "m 3"], points: Float[Tensor, "n 3"], count: int, radius: float
) -> tuple[Int[Tensor, "m count"], Float[Tensor, "m count"]]:
    """See `invgraphics.kernels.near_points`."""
    m, n = len(position), len(points)
    index = torch.full((m, count), -1, dtype=torch.int64)
    squared = torch.full((m, count), torch.inf)
    if m == 0 or n == 0:
        return index, squared
    known = points.detach()
    lo = known.amin(dim=0)
    size = known.amax(dim=0).double() - lo.double()
    if not bool(size.isfinite().all()):
        # Points that are not finite are near nothing, and would leave the others without a grid.
        finite = known.isfinite().all(dim=1).nonzero()[:, 0]
        index, squared = near_points(position, known[finite], count, radius)
        return torch.where(index >= 0, finite[index.clamp_min(0)], -1) if len(finite) else index, squared
    # A little wider than the radius, so that rounding, up to about 1e-7 of the cells along an edge, puts no neighbour into the
    # cell after the next.
    edge = max(radius * (1 + 1e-4), 1e-12)
    while math.prod((size / edge + 1).floor().tolist()) > MOST_CELLS:
        edge *= 1.25
    shape = (size / edge).long().numpy() + 1
    # float64, in which differences of float32 cannot overflow.
    flat, corner, inverse, jobs = array(known), lo.double().numpy(), 1 / edge, threads()
    cells = int(np.prod(shape))
    cell, order = scratch("near.cell", n, np.int64), scratch("near.order", n, np.int64)
    first = scratch("near.first", cells + 1, np.int64)
    fill_cells(flat, corner, inverse, shape, jobs, cell, first, order)
    limit = np.float32(radius * radius)
    found = index.numpy(), squared.numpy()
    find_near(array(position), flat, corner, inverse, shape, first, order, limit, jobs, *found)
    return index, squared
