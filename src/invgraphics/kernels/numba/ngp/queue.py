"""A queue of rays in flight: fused rendering and early-terminated marching evaluate one interval of `POINTS` rays at a time.

A job keeps one ray in each of `POINTS` batch lanes and evaluates the next occupied interval of all of them. A ray that has
terminated or has left the volume is replaced at once. Rays that have used up their buffered intervals wait until `LANES` of
them can be marched on together, filled up with new rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.rays.traversal import (
    RAY_FLOATS,
    STATE_FLOATS,
    idle_lane,
    march_rays,
    read_state,
    set_ray,
    set_state,
    to_unit,
)
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined
from invgraphics.kernels.numba.simd.lanes import load, store
from invgraphics.kernels.numba.simd.partial import doubles_at, floats_at, longs_at

AHEAD = 16
"""Occupied intervals of a ray that are marched ahead and buffered."""
ROW = AHEAD + 1
"""Size of a slot's buffer: a march writes one interval more, of no meaning."""
EDGE = 8
"""Edge in pixels of the image blocks that are scheduled to a job."""
BLOCK = EDGE * EDGE
SLOTS = int(POINTS) + 4 * GROUP
"""Rays in flight. When `LANES` of them are marched, none is ready for a batch lane, and fewer than twice as many wait."""
READY, WAITING, MARCHING, FREE, SCHEDULED = range(5)
"""Lists of slots by status, and the index in ``counts`` of the number of rays scheduled so far."""

_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_LIMIT = np.float32(AHEAD)
_1, _2, _3, _4, _5 = (POINTS * index(k) for k in range(1, 6))


class RayQueue(NamedTuple):
    """Rays in flight of one job, kept in slots, and lists of slots by status.

    Attributes:
        slots: slot of the ray in each batch lane, -1 for none.
        midpoints: distance of the midpoint of each batch lane's interval.
        lane_rays: origins and directions of the batch lanes' rays, structure of arrays.
        ray_index: index of each slot's ray.
        t0: starts of buffered intervals, `ROW` for each slot.
        t1: ends of buffered intervals.
        buffered: number of buffered intervals of each slot.
        consumed: number of those that have been evaluated.
        steps: lattice index of each slot's next step.
        resume: distance at which each slot's march resumes.
        transmittance: of each slot's ray, float64.
        error: summed weight of the samples of each slot whose colour was not evaluated.
        harmonics: spherical harmonics of each slot's direction (see `harmonics_offset`).
        lists: slots by status.
        counts: lengths of the lists, and number of rays scheduled.
        march_rays: `traversal.RAY_FLOATS` of each ray that is being marched.
        march_state: `traversal.STATE_FLOATS` of each.
    """

    slots: np.ndarray
    midpoints: np.ndarray
    lane_rays: np.ndarray
    ray_index: np.ndarray
    t0: np.ndarray
    t1: np.ndarray
    buffered: np.ndarray
    consumed: np.ndarray
    steps: np.ndarray
    resume: np.ndarray
    transmittance: np.ndarray
    error: np.ndarray
    harmonics: np.ndarray
    lists: np.ndarray
    counts: np.ndarray
    march_rays: np.ndarray
    march_state: np.ndarray


_FLOATS = (POINTS, 6 * POINTS, *2 * [(SLOTS + 1) * ROW], *3 * [SLOTS], 16 * SLOTS, RAY_FLOATS * GROUP, STATE_FLOATS * GROUP)
"""Numbers of float32 values: midpoints, lane_rays, t0, t1, steps, resume, error, harmonics, march_rays, march_state."""
_FLOATS_AT = tuple(8 * int(sum(-(-int(size) // 2) for size in _FLOATS[:k])) for k in range(len(_FLOATS) + 1))
"""First byte of each, and of what follows them: int64 and float64 numbers."""
_LONGS = (int(POINTS), *3 * [SLOTS], (FREE + 1) * SLOTS, SCHEDULED + 1, SLOTS)
"""Numbers of those: slots, ray_index, buffered, consumed, lists, counts, transmittance."""
_LONGS_AT = tuple(_FLOATS_AT[-1] + 8 * sum(_LONGS[:k]) for k in range(len(_LONGS)))
QUEUE_BYTES = _LONGS_AT[-1] + 8 * _LONGS[-1]
"""Memory of a job's queue."""


def queue_memory(jobs: int) -> np.ndarray:
    """Zeros for the queues of all jobs."""
    return np.zeros((jobs, QUEUE_BYTES // 8), np.int64)


@inlined
def empty_queue(memory, job):
    """A queue without rays, all slots free, all batch lanes idle, in a job's part of `queue_memory`.

    Its arrays are not counted (see `simd.partial`).
    """
    at = np.int64(memory.ctypes.data) + QUEUE_BYTES * np.int64(job)
    f, n = _FLOATS_AT, _LONGS_AT
    queue = RayQueue(
        longs_at(at + n[0], int(POINTS)), floats_at(at + f[0], POINTS), floats_at(at + f[1], 6 * POINTS),
        longs_at(at + n[1], SLOTS),
        # One row more, for lanes that have no ray.
        floats_at(at + f[2], (SLOTS + 1) * ROW), floats_at(at + f[3], (SLOTS + 1) * ROW),
        longs_at(at + n[2], SLOTS), longs_at(at + n[3], SLOTS),
        floats_at(at + f[4], SLOTS), floats_at(at + f[5], SLOTS), doubles_at(at + n[6], SLOTS), floats_at(at + f[6], SLOTS),
        floats_at(at + f[7], 16 * SLOTS), longs_at(at + n[4], (FREE + 1, SLOTS)), longs_at(at + n[5], SCHEDULED + 1),
        floats_at(at + f[8], RAY_FLOATS * GROUP), floats_at(at + f[9], STATE_FLOATS * GROUP),
    )  # fmt: skip
    for p in range(POINTS):
        queue.slots[p] = -1
    for s in range(SLOTS):
        _push(queue, FREE, s)
    return queue


@inlined
def _push(queue, status, s):
    queue.lists[status, queue.counts[status]] = s
    queue.counts[status] += 1


@inlined
def _pop(queue, status):
    queue.counts[status] -= 1
    return queue.lists[status, queue.counts[status]]


@inlined
def _next_ray(queue, schedule, count):
    """Index of the next ray of a job's schedule, -1 at its end.

    Jobs take blocks of the image in turn, `EDGE` by `EDGE` pixels: rays of neighbouring pixels meet the same cells and entries,
    and march alike.
    """
    job, jobs, width = schedule
    across = (width + EDGE - 1) // EDGE
    while True:
        block, pixel = queue.counts[SCHEDULED] // BLOCK * jobs + job, queue.counts[SCHEDULED] % BLOCK
        down = block // across
        if down * EDGE * width >= count:
            return -1
        queue.counts[SCHEDULED] += 1
        column = (block - down * across) * EDGE + pixel % EDGE
        r = (down * EDGE + pixel // EDGE) * width + column
        if column < width and r < count:
            return r


@inlined
def _start_ray(queue, schedule, start):
    """Move the next scheduled ray into a free slot; returns the slot, -1 where no ray or no slot is left."""
    r = _next_ray(queue, schedule, len(start)) if queue.counts[FREE] > 0 else -1
    if r < 0:
        return -1
    s = _pop(queue, FREE)
    queue.ray_index[s], queue.buffered[s], queue.steps[s], queue.resume[s] = r, 0, _ZERO, start[r]
    queue.transmittance[s], queue.error[s] = 1.0, _ZERO
    return s


@inlined
def harmonics_offset(s):
    """Offset of the first spherical harmonic of slot ``s``; the others follow `LANES` numbers apart."""
    return (index(s) // LANES) * index(16) * LANES + index(s) % LANES


@inlined
def _fill_march_lanes(schedule, rays, queue):
    """Load up to `LANES` rays for marching: new ones, which are neighbours, unless enough others wait; returns how many."""
    origins, directions, start, far = rays
    n, enough = 0, queue.counts[WAITING] >= GROUP
    for lane in range(GROUP):
        s = -1 if enough else _start_ray(queue, schedule, start)
        if s < 0 and queue.counts[WAITING] > 0:
            s = _pop(queue, WAITING)
        if s < 0:
            # Idle lanes write to a row of their own.
            idle_lane(queue.march_rays, queue.march_state, lane, SLOTS * ROW)
            continue
        r, n = queue.ray_index[s], n + 1
        queue.lists[MARCHING, lane] = s
        # The lattice is counted from the ray's start, so that these are the very steps of an ordinary march.
        set_ray(queue.march_rays, lane, origins, directions, r, start[r], far[r])
        set_state(queue.march_state, lane, s * ROW, queue.steps[s], queue.resume[s])
    return n


@inlined
def _march_ahead(schedule, rays, setup, queue):
    """Buffer the next occupied intervals of up to `LANES` rays; returns whether there were any rays."""
    n = _fill_march_lanes(schedule, rays, queue)
    if n > 0:
        march_rays(queue.march_rays, queue.march_state, _LIMIT, setup, queue.t0, queue.t1)
    for lane in range(n):
        s = queue.lists[MARCHING, lane]
        new = queue.buffered[s] == 0
        queue.buffered[s], queue.steps[s], queue.resume[s] = read_state(queue.march_state, lane)
        queue.consumed[s] = 0
        if queue.buffered[s] > 0:
            r = queue.ray_index[s]
            if new:
                harmonics((rays[1][r, 0], rays[1][r, 1], rays[1][r, 2]), queue.harmonics, harmonics_offset(s))
            _push(queue, READY, s)
        else:
            _push(queue, FREE, s)
    return n > 0


@inlined
def _assign_lane(p, schedule, rays, setup, queue):
    """Assign the next ready ray to batch lane ``p``; returns whether there is one."""
    origins, directions, _, far = rays
    s = queue.slots[p]
    if s >= 0:
        _push(queue, WAITING if queue.resume[s] < far[queue.ray_index[s]] else FREE, s)
        queue.slots[p] = -1
    while queue.counts[READY] == 0:
        if not _march_ahead(schedule, rays, setup, queue):
            return False
    s = _pop(queue, READY)
    queue.slots[p] = s
    for axis in range(3):
        queue.lane_rays[index(axis) * POINTS + index(p)] = origins[queue.ray_index[s], axis]
        queue.lane_rays[index(3 + axis) * POINTS + index(p)] = directions[queue.ray_index[s], axis]
    return True


@inlined
def next_samples(schedule, rays, setup, queue, points):
    """Write the next sample position of every batch lane, in the unit cube, to ``points``; returns whether there are any."""
    busy = False
    for p in range(POINTS):
        s = queue.slots[p]
        if (s >= 0 and queue.consumed[s] < queue.buffered[s]) or _assign_lane(p, schedule, rays, setup, queue):
            begin, end = current_interval(queue, queue.slots[p])
            queue.midpoints[p] = (begin + end) * _HALF
            busy = True
    box, contracted = setup[0], setup[3]
    for part in range(POINTS // LANES):
        at = index(part) * LANES
        t = load(queue.midpoints, at)
        x = load(queue.lane_rays, at) + t * load(queue.lane_rays, at + _3)
        y = load(queue.lane_rays, at + _1) + t * load(queue.lane_rays, at + _4)
        z = load(queue.lane_rays, at + _2) + t * load(queue.lane_rays, at + _5)
        x, y, z = to_unit(box, contracted, x, y, z)
        store(points, at, x)
        store(points, at + _1, y)
        store(points, at + _2, z)
    return busy


@inlined
def current_interval(queue, s):
    """Start and end of the interval that the ray of slot ``s`` is at."""
    at = s * ROW + queue.consumed[s]
    return queue.t0[at], queue.t1[at]


@inlined
def terminate(queue, s, far):
    """Terminate the ray of slot ``s``."""
    queue.consumed[s], queue.resume[s] = queue.buffered[s], far[queue.ray_index[s]]
