"""Gradient of the lattice encoding in the features; through products, without an array of their factors' gradients.

``gradient`` is always contiguous float32 (m, width), in which the gradient of a lattice, or of the product that it is a factor
of, begins at its record's ``column``.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.hash.cells import ZERO
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, EMPTY, WRITE, corners_of, job_scratch, locate_block
from invgraphics.kernels.numba.lattice.pairs import is_pair, scatter_pair
from invgraphics.kernels.numba.lattice.rows import interpolate_block, load_part, scatter_block
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, job_start, parallel, prange, serial
from invgraphics.kernels.numba.simd.lanes import load, store
from invgraphics.kernels.numba.simd.partial import floats_at, unowned

SAMPLE = 61
"""Stride of the points that show where on a lattice the work lies: a prime, so that it keeps step with no number of samples."""
TARGET = np.dtype([(name, np.int64) for name in ("gradient", "copy")])
"""Per lattice: address of its features' gradient, 0 where none is wanted; first float in a job's copy, -1 for no copy."""
PASS = np.dtype([(name, np.int64) for name in ("first", "end", "pivot", "copied")])
"""A pass over a group of lattices (see `passes_over`)."""
_FLOAT = 4


def passes_over(lattices: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Passes over the points that write all wanted gradients.

    A pass shares out the points. Those of a pass with a pivot, a lattice too large for copies, go to the jobs that own rows
    around them; without one, every job gets equally many. Lattices with copies are written in the group's first pass.
    """
    passes = []
    for first in np.unique(lattices["group"]):
        members = range(first, lattices["group_end"][first])
        wanted = [k for k in members if targets["gradient"][k]]
        pivots = [k for k in wanted if targets["copy"][k] < 0]
        if wanted:
            passes += [(first, members.stop, pivot, turn == 0) for turn, pivot in enumerate(pivots or [-1])]
    return np.array(passes, PASS)


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
    if samples and jobs > 1:
        rows = np.empty((len(lattices), samples), np.uint32)
        sample_rows(positions, lattices, rows)
        rows.sort(axis=1)
        starts[:, 1:-1] = np.minimum(rows[:, [samples * job // jobs for job in range(1, jobs)]], lattices["rows"][:, None])
    return starts


@inlined
def list_points(count, chosen):
    """All points of a block."""
    for number in range(count):
        chosen[number] = number
    return count


@inlined
def _select_points(lattice, entries, count, owned, touched, led):
    """Points around which an owned row may lie, and those among them whose first row is owned: of those, no two jobs share one.

    Rows of a dense cell lie between those of its first and last corner.
    """
    start, end = owned
    found, first, last = 0, 0, index((lattice.corners - 1) * BLOCK)
    for number in range(count):
        n = index(number)
        near, leads, leading = entries[n] < end and entries[n + last] >= start, entries[n] >= start and entries[n] < end, True
        if lattice.links != 0:
            near, leads = False, False
            for corner in range(lattice.corners):
                row = entries[index(corner * BLOCK) + n]
                mine = row >= start and row < end
                near |= mine
                if leading and row != EMPTY:
                    leads, leading = mine, False
        touched[found], led[first] = number, number
        found, first = found + near, first + leads
    return found, first


@inlined
def _multiply(lattice, points, gradient, place, width, values, slot, factors):
    """Gradient of a product at a block's points times the values of one factor, into ``factors``."""
    chosen, count = points
    stride, part = index(lattice.stride), min(index(lattice.channels), LANES)
    last = max(lattice.channels - GROUP, 0)
    for point in range(count):
        n = index(chosen[point])
        for start in range(0, lattice.channels, GROUP):
            k = index(min(start, last))
            product = load_part(gradient, place + n * width + k, part) * load(values, slot + n * stride + k)
            store(factors, n * stride + k, product)


@inlined
def _multiply_in_place(lattice, points, values, slot, factors):
    """Multiply ``factors`` by the values of one more factor; registers do not overlap here, or some would count twice."""
    chosen, count = points
    stride = index(lattice.stride)
    for point in range(count):
        n = index(chosen[point])
        for start in range(0, lattice.channels, GROUP):
            at = n * stride + index(start)
            store(factors, at, load(factors, at) * load(values, slot + at))


@inlined
def _factor_gradients(gradient, place, width, lattices, number, points, values, factors):
    """Gradient of one factor at a block's points: that of the product, times the values of the other factors.

    ``values`` holds what `interpolate_block` found for each lattice of the group, at its ``slot``.
    """
    lattice = lattices[number]
    begun = lattice.group + (1 if number == lattice.group else 0)
    _multiply(lattice, points, gradient, place, width, values, index(lattices[begun].slot), factors)
    for other in range(begun + 1, lattice.group_end):
        if other != number:
            _multiply_in_place(lattice, points, values, index(lattices[other].slot), factors)


@inlined
def _rows_of(lattice, target, one, number, job, starts, copies):
    """Which rows a job may write of a lattice in a pass (none: an empty range), and the address of the first row of all."""
    if target.gradient == 0 or (number != one.pivot and (target.copy < 0 or one.copied == 0)):
        return np.int64(0), np.int64(0), np.int64(0)
    if number == one.pivot:
        return starts[number, job], starts[number, job + 1], target.gradient
    return np.int64(0), lattice.rows, target.gradient if job == 0 else copies + _FLOAT * target.copy


@inlined
def _clear(lattices, targets, starts, job, copies):
    """Fill what a job owns of every gradient with zeros."""
    for number in range(len(lattices)):
        lattice, target = lattices[number], targets[number]
        channels = lattice.channels
        if target.gradient != 0:
            if target.copy < 0:
                owned = floats_at(target.gradient, lattice.rows * channels)
                owned[starts[number, job] * channels : starts[number, job + 1] * channels] = ZERO
            else:
                copy = floats_at(target.gradient if job == 0 else copies + _FLOAT * target.copy, lattice.rows * channels)
                copy[:] = ZERO


@inlined
def _points_of(positions, block, lattices, one, starts, job, scratch):
    """Indices of a job's points in a block, and those whose copies it writes; corners of the pivot are found on the way."""
    _, _, _, touched, led = scratch
    if one.pivot < 0:
        list_points(block[1], touched)
        return list_points(block[1], led), block[1]
    pivot, (entries, weights) = lattices[one.pivot], corners_of(scratch, one.pivot - one.first)
    locate_block(positions, block, pivot, entries, weights)
    owned = starts[one.pivot, job], starts[one.pivot, job + 1]
    return _select_points(pivot, entries, block[1], owned, touched, led)


@inlined
def interpolate_group(lattices, first, end, points, scratch):
    """Values of every factor of a product at a block's points."""
    for number in range(first, end):
        lattice, (entries, weights) = lattices[number], corners_of(scratch, number - first)
        slot, stride = index(lattice.slot), index(lattice.stride)
        interpolate_block(lattice, entries, weights, points, WRITE, scratch[1], slot, stride)


@inlined
def gradient_of(gradient, block, lattices, number, points, scratch):
    """Where the gradient of a lattice's own values is found: flat array, place of the block's first point, and stride.

    ``gradient`` is that of all features, flat, and their number.
    """
    flat, width = gradient
    lattice = lattices[number]
    place = block[0] * width + index(lattice.column)
    if lattice.group_end - lattice.group == 1:
        return flat, place, width
    _factor_gradients(flat, place, width, lattices, number, points, scratch[1], scratch[2])
    return scratch[2], index(0), index(lattice.stride)


@inlined
def _visit_block(positions, gradient, block, lattices, targets, one, starts, job, copies, scratch):
    """Add the gradients of a job's points in a block to the rows that it may write in this pass."""
    _, _, _, touched, led = scratch
    count, leaders = _points_of(positions, block, lattices, one, starts, job, scratch)
    if count > 0:
        for number in range(one.first, one.end):
            if number != one.pivot:
                entries, weights = corners_of(scratch, number - one.first)
                locate_block(positions, block, lattices[number], entries, weights)
        points = touched, count, led, leaders
        if is_pair(lattices, one.first, one.end):
            _visit_pair(gradient, block, lattices, targets, one, starts, job, copies, scratch, points)
        else:
            _visit_group(gradient, block, lattices, targets, one, starts, job, copies, scratch, points)


@inlined
def _visit_group(gradient, block, lattices, targets, one, starts, job, copies, scratch, points):
    """`_visit_block` for any number of factors."""
    touched, count, led, leaders = points
    if one.end - one.first > 1:
        interpolate_group(lattices, one.first, one.end, (touched, count), scratch)
    for number in range(one.first, one.end):
        lattice, (entries, weights) = lattices[number], corners_of(scratch, number - one.first)
        start, end, address = _rows_of(lattice, targets[number], one, number, job, starts, copies)
        if start < end:
            some = (touched, count) if number == one.pivot else (led, leaders)
            source = gradient_of(gradient, block, lattices, number, some, scratch)
            grad_rows = floats_at(address, lattice.rows * lattice.channels)
            scatter_block(lattice, entries, weights, some, (start, end), source, grad_rows)


@inlined
def _visit_pair(gradient, block, lattices, targets, one, starts, job, copies, scratch, points):
    """`_visit_block` for a product of two."""
    flat, width = gradient
    owner = max(one.pivot, one.first)
    other = one.first + one.end - 1 - owner
    a, b = lattices[owner], lattices[other]
    start, end, address = _rows_of(a, targets[owner], one, owner, job, starts, copies)
    begin, stop, whole = _rows_of(b, targets[other], one, other, job, starts, copies)
    members, source = (owner - one.first, other - one.first), (flat, block[0] * width + index(a.column), width)
    scatter_pair(a, b, scratch, members, points, (start, end), source, (address, whole if begin < stop else np.int64(0)))


@parallel
def feature_gradients(positions, gradient, lattices, targets, passes, starts, copies, memory, sizes, jobs):
    """Gradients of all lattices' features, at the addresses in ``targets``.

    No row is written by two jobs. Of a large lattice, each job owns a range of rows, ``starts``; of a small one, a copy of its
    own (the first job the gradient itself), to be added up by `add_copies`: ``copies`` are the address of the second job's and
    the bytes of each job's. Either is written in the order of the points.
    """
    points = positions.shape[1]
    for job in prange(jobs):
        scratch, own = job_scratch(memory, sizes, job), copies[0] + copies[1] * (np.int64(job) - 1)
        received = unowned(gradient), index(gradient.shape[1])
        _clear(lattices, targets, starts, job, own)
        for turn in range(len(passes)):
            one = passes[turn]
            alone = one.pivot >= 0
            begin, end = (0, points) if alone else (job_start(points, jobs, job), job_start(points, jobs, job + 1))
            for first in range(begin, end, BLOCK):
                block = index(first), min(BLOCK, end - first)
                _visit_block(positions, received, block, lattices, targets, one, starts, job, own, scratch)


@parallel
def add_copies(lattices, targets, copies, jobs):
    """Add the other jobs' copies of small lattices' gradients to the first one's, in the order of the jobs."""
    for job in prange(jobs):
        for number in range(len(lattices)):
            lattice, target = lattices[number], targets[number]
            size = lattice.rows * lattice.channels
            if target.gradient != 0 and target.copy >= 0:
                total = floats_at(target.gradient, size)
                for other in range(jobs - 1):
                    copy = floats_at(copies[0] + copies[1] * other + _FLOAT * target.copy, size)
                    for at in range(job_start(size, jobs, job), job_start(size, jobs, job + 1)):
                        total[index(at)] += copy[index(at)]
