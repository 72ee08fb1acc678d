"""Sphere tracing of a signed distance over a hash grid or octaves in one pass: `POINTS` rays at a time, each in a batch lane.

A ray that is finished is replaced at once. Every lane is at one of three things: it marches, refines its hit, or refines its
closest approach. Judged by `invgraphics.kernels.reference.tracing`.
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
from invgraphics.kernels.numba.ngp.lane_state import (
    ENDED,
    LOW_T,
    RESULTS,
    ROWS,
    STEPS,
    begin_closest,
    begin_hit,
    begin_ray,
    march,
    marches,
    next_positions,
    stop_marching,
    take_closest,
    take_hit,
)
from invgraphics.kernels.numba.ngp.network import encode
from invgraphics.kernels.numba.runtime import LANES, array, index, inlined, parallel, prange, threads
from invgraphics.kernels.numba.simd.lanes import load, store
from invgraphics.kernels.reference.tracing import result
from invgraphics.kernels.types import TracedRays, TracingLimits

_MARCH, _HIT, _CLOSEST, _DONE = range(4)
_ZERO = np.float32(0)
_RUN = 32
"""Consecutive rays that are given to one job before the next job has its turn."""


@inlined
def _advance(state, p, value, phase, looked, limits):
    """Take a distance into lane ``p``, which does not march or no longer; returns its next phase.

    ``looked`` are the refinements so far in this phase, counted per lane.
    """
    refinements = limits[2]
    if phase == _MARCH:
        stop_marching(state, p)
        if refinements > 0 and begin_hit(state, p, limits):
            return _HIT
    elif phase == _HIT:
        take_hit(state, p, value)
        looked[p] += 1
        if looked[p] < refinements and begin_hit(state, p, limits):
            return _HIT
        looked[p] = 0
    else:
        take_closest(state, p, value)
        looked[p] += 1
    more = looked[p] < refinements and begin_closest(state, p, limits)
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
        net: layers and sizes as `pack_network` returns them; its inputs are the features, then what `coordinates` writes.
        widest: largest number of inputs or outputs of any layer.
        settings: sharpness, scale of the distance, scales of the coordinates.
        limits: as `TracingLimits`.
        jobs: number of jobs.
        results: output (11, n), rows of state; infinite before.
        steps: output (n,), look-ups of each ray.
        ended: output (n,), whether a ray ended before its look-ups were used up.
    """
    origins, directions, near, far = rays
    first = index(2 * len(levels[0])) * POINTS
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        state, distance = np.zeros((ROWS, POINTS), np.float32), np.zeros(POINTS, np.float32)
        flat_state, flat_points = state.reshape(-1), points.reshape(-1)
        lane_ray, phase, looked = np.full(POINTS, -1, np.int64), np.zeros(POINTS, np.int64), np.zeros(POINTS, np.int64)
        busy, cursor, left = 0, 0, True
        while True:
            for p in range(POINTS):
                if left and lane_ray[p] < 0:
                    r, cursor = _next_ray(cursor, job, jobs, near, far)
                    left = r >= 0
                    if left:
                        begin_ray(state, p, (origins[r], directions[r], near[r], far[r]), box)
                        lane_ray[p], phase[p], looked[p], busy = r, _MARCH, 0, busy + 1
            if busy == 0:
                break
            next_positions(flat_state, flat_points)
            encode(table, levels, points, entries, weights, x)
            coordinates(points, x, first, settings, octaves)
            raw = distances(net, x, ping, pong, settings[0])
            for half in range(2):
                at = index(half) * LANES
                value = load(raw, at) * settings[1]
                store(distance, at, value)
                march(flat_state, at, value, limits)
            for p in range(POINTS):
                r = lane_ray[p]
                if r >= 0 and not marches(state, p):
                    phase[p] = _advance(state, p, distance[p], phase[p], looked, limits)
                    if phase[p] == _DONE:
                        for row in range(RESULTS):
                            results[row, r] = state[row, p]
                        steps[r], ended[r] = np.int64(state[STEPS, p]), state[ENDED, p] > _ZERO
                        lane_ray[p], busy = -1, busy - 1


@torch.no_grad()
def sdf_trace(rays: Rays, bounds: Bounds, field: FusedSDF, limits: TracingLimits) -> TracedRays:
    """See `invgraphics.kernels.sdf_trace`; other than two features per entry are left to the reference."""
    if field.table.shape[1] != 2:
        return reference.sdf_trace(rays, bounds, field, limits)
    batch = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    box = array(bounds.lo), array(1 / (bounds.hi - bounds.lo))
    lengths = (np.float32(value) for value in (limits.least, limits.tolerance, limits.depth))
    stops = limits.steps, np.float32(limits.relaxation), limits.refinements, *lengths
    results = torch.full((RESULTS, len(rays)), torch.inf)
    results[LOW_T] = rays.near
    steps, ended = torch.zeros(len(rays), dtype=torch.long), rays.far <= rays.near
    outputs = results.numpy(), steps.numpy(), ended.numpy()
    trace(batch, box, *pack_sdf(field), stops, threads(), *outputs)
    return result(results, steps, ended, rays, limits)
