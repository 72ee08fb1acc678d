"""Sphere tracing of a signed distance over a hash grid or octaves in one pass: `POINTS` rays at a time, each in a batch lane.

A ray that is finished is replaced at once. Every lane is at one of three things: it marches, refines its hit, or refines its
closest approach. Judged by `invgraphics.kernels.reference.tracing`, whose rows of state these are.
"""

from __future__ import annotations

import numpy as np
import torch

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.core.rays import Rays
from invgraphics.kernels import reference
from invgraphics.kernels.numba.hash.cells import BLOCK
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.ngp.distance import coordinates, distances, pack_sdf
from invgraphics.kernels.numba.ngp.network import encode
from invgraphics.kernels.numba.runtime import array, index, inlined, parallel, prange, threads
from invgraphics.kernels.reference.tracing import GOLDEN, ROUNDING, result
from invgraphics.kernels.types import TracedRays, TracingLimits

_T, _F, _LOW, _LOW_T, _LOW_A, _LOW_B, _HIT_A, _HIT_FA, _HIT_B, _HIT_FB, _NEXT = range(11)
_ROWS = 11
_MARCH, _HIT, _CLOSEST, _DONE = range(4)
_RUN = 32
"""Consecutive rays that are given to one job before the next job has its turn."""

_ZERO, _HALF, _INFINITE = np.float32(0), np.float32(0.5), np.float32(np.inf)
_GOLDEN, _ROUNDING = np.float32(GOLDEN), np.float32(ROUNDING)


@inlined
def _start(state, p, near):
    """Begin a ray in lane ``p``."""
    for row in range(_ROWS):
        state[row, p] = _INFINITE
    state[_T, p] = state[_LOW_T, p] = state[_LOW_A, p] = state[_NEXT, p] = near
    state[_F, p] = _ZERO


@inlined
def _march(state, p, value, limits):
    """Take a distance into a marching ray's state."""
    relaxation, least, depth = limits[1], limits[3], limits[5]
    t, before_t, before = state[_NEXT, p], state[_T, p], state[_F, p]
    first = state[_LOW, p] == _INFINITE
    safe, jump = max(abs(before), least), t - before_t
    relaxed = before > _ZERO and jump - safe > _ROUNDING * (t + safe)
    if relaxed and not first and abs(value) + before < jump:
        state[_NEXT, p] = before_t + safe
        return
    if value <= _ZERO and state[_HIT_B, p] == _INFINITE:
        state[_HIT_A, p], state[_HIT_FA, p] = (t, value) if first else (before_t, before)
        state[_HIT_B, p], state[_HIT_FB, p] = t, value
    if value < state[_LOW, p]:
        state[_LOW, p], state[_LOW_T, p], state[_LOW_A, p], state[_LOW_B, p] = value, t, before_t, t
    elif state[_LOW_T, p] == before_t and not first:
        state[_LOW_B, p] = t
    step = max(relaxation * value, least) if value > _ZERO else max(-value, depth, least)
    state[_T, p], state[_F, p], state[_NEXT, p] = t, value, t + step


@inlined
def _begin_hit(state, p, limits):
    """Look next at the false position of a hit that is not exact yet; returns whether it has to be refined."""
    b = state[_HIT_B, p]
    if b == _INFINITE or abs(state[_HIT_FB, p]) <= limits[4] or state[_HIT_A, p] == b:
        return False
    share = state[_HIT_FB, p] / (state[_HIT_FB, p] - state[_HIT_FA, p])
    state[_NEXT, p] = b + (state[_HIT_A, p] - b) * share
    return True


@inlined
def _take_hit(state, p, value):
    """Take a distance into the bracket of a hit (Illinois)."""
    if value * state[_HIT_FB, p] < _ZERO:
        state[_HIT_A, p], state[_HIT_FA, p] = state[_HIT_B, p], state[_HIT_FB, p]
    else:
        state[_HIT_FA, p] *= _HALF
    state[_HIT_B, p], state[_HIT_FB, p] = state[_NEXT, p], value


@inlined
def _begin_closest(state, p, limits):
    """Look next at the golden section of the closest approach; returns whether it has to be refined."""
    a, m, b = state[_LOW_A, p], state[_LOW_T, p], state[_LOW_B, p]
    if not (abs(state[_LOW, p]) < limits[5] and b < _INFINITE and b > m > a):
        return False
    state[_NEXT, p] = m + _GOLDEN * (b - m if b - m > m - a else a - m)
    return True


@inlined
def _take_closest(state, p, value):
    """Take a distance into the bracket of a closest approach."""
    t, m = state[_NEXT, p], state[_LOW_T, p]
    if value < state[_LOW, p]:
        if t > m:
            state[_LOW_A, p] = m
        else:
            state[_LOW_B, p] = m
        state[_LOW, p], state[_LOW_T, p] = value, t
    elif t > m:
        state[_LOW_B, p] = t
    else:
        state[_LOW_A, p] = t


@inlined
def _advance(state, p, value, phase, counts, far, limits):
    """Take a distance into lane ``p`` in its phase; returns the next phase. ``counts``: steps, refinements, whether ended."""
    most, refinements = limits[0], limits[2]
    if phase == _MARCH:
        _march(state, p, value, limits)
        counts[0, p] += 1
        # A step ends a ray only as far as its sphere reaches: behind that, an over-relaxed one has to be looked at first.
        t, value = state[_T, p], state[_F, p]
        ended = value < -limits[5] or t + max(abs(value), limits[3]) > far or t >= far
        state[_NEXT, p] = min(state[_NEXT, p], far)
        if not ended and counts[0, p] < most:
            return _MARCH
        counts[2, p] = 1 if ended else 0
        if refinements > 0 and _begin_hit(state, p, limits):
            return _HIT
    elif phase == _HIT:
        _take_hit(state, p, value)
        counts[1, p] += 1
        if counts[1, p] < refinements and _begin_hit(state, p, limits):
            return _HIT
        counts[1, p] = 0
    else:
        _take_closest(state, p, value)
        counts[1, p] += 1
    more = counts[1, p] < refinements and _begin_closest(state, p, limits)
    return _CLOSEST if more else _DONE


@inlined
def _next_ray(cursor, job, jobs, near, far):
    """Index of the job's next ray with an interval, -1 at the end; and the cursor behind it. Jobs take runs of rays in turn."""
    while True:
        r = (cursor // _RUN * jobs + job) * _RUN + cursor % _RUN
        cursor += 1
        if r >= len(near):
            if (cursor - 1) % _RUN == 0:
                return -1, cursor - 1
        elif far[r] > near[r]:
            return r, cursor


@parallel
def trace(rays, box, table, levels, octaves, net, widest, settings, limits, jobs, results, steps, ended):
    """States of all rays at their ends.

    Args:
        rays: origins, directions, starts and ends.
        box: lowest corner, and 1 over the edges.
        table: features, flat.
        levels: see `levels_of`.
        octaves: number of octaves behind the coordinates, -1 for none.
        net: layers and sizes as `pack_network` returns them; its inputs are the grid's features, then what `coordinates` says.
        widest: largest number of inputs or outputs of any layer.
        settings: sharpness, scale of the distance, scales of the coordinates.
        limits: as `TracingLimits`.
        jobs: number of jobs.
        results: output (11, n), rows of state; infinite before.
        steps: output (n,), look-ups of each ray.
        ended: output (n,), whether a ray ended before its look-ups were used up.
    """
    origins, directions, near, far = rays
    lo, inverse = box
    first = index(2 * len(levels[0])) * POINTS
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        state, counts = np.zeros((_ROWS, POINTS), np.float32), np.zeros((3, POINTS), np.int64)
        lane_ray, phase = np.full(POINTS, -1, np.int64), np.zeros(POINTS, np.int64)
        cursor = 0
        while True:
            busy = 0
            for p in range(POINTS):
                if lane_ray[p] < 0:
                    lane_ray[p], cursor = _next_ray(cursor, job, jobs, near, far)
                    phase[p], counts[0, p], counts[1, p] = _MARCH, 0, 0
                    if lane_ray[p] >= 0:
                        _start(state, p, near[lane_ray[p]])
                if lane_ray[p] >= 0:
                    busy, r = busy + 1, lane_ray[p]
                    for axis in range(3):
                        position = origins[r, axis] + state[_NEXT, p] * directions[r, axis]
                        points[axis, p] = (position - lo[axis]) * inverse[axis]
            if busy == 0:
                break
            encode(table, levels, points, entries, weights, x)
            coordinates(points, x, first, settings, octaves)
            raw = distances(net, x, ping, pong, settings[0])
            for p in range(POINTS):
                r = lane_ray[p]
                if r >= 0:
                    phase[p] = _advance(state, p, raw[p] * settings[1], phase[p], counts, far[r], limits)
                    if phase[p] == _DONE:
                        for row in range(_ROWS):
                            results[row, r] = state[row, p]
                        steps[r], ended[r], lane_ray[p] = counts[0, p], counts[2, p] > 0, -1


@torch.no_grad()
def sdf_trace(rays: Rays, bounds: Bounds, field: FusedSDF, limits: TracingLimits) -> TracedRays:
    """See `invgraphics.kernels.sdf_trace`; other than two features per entry are left to the reference."""
    if field.table.shape[1] != 2:
        return reference.sdf_trace(rays, bounds, field, limits)
    batch = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    box = array(bounds.lo), array(1 / (bounds.hi - bounds.lo))
    lengths = (np.float32(value) for value in (limits.least, limits.tolerance, limits.depth))
    stops = limits.steps, np.float32(limits.relaxation), limits.refinements, *lengths
    results = torch.full((_ROWS, len(rays)), torch.inf)
    results[_LOW_T] = rays.near
    steps, ended = torch.zeros(len(rays), dtype=torch.long), rays.far <= rays.near
    outputs = results.numpy(), steps.numpy(), ended.numpy()
    trace(batch, box, *pack_sdf(field), stops, threads(), *outputs)
    return result(results, steps, ended, rays, limits)
