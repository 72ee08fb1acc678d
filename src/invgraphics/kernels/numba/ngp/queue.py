"""Many rays under way at once: what pictures of hash grids in one pass and marches that stop have in common.

A job keeps `POINTS` rays in as many places and looks at the next occupied step of all of them. A ray that has met something
opaque, or has left, makes room for another one at once. Rays whose steps are used up wait until there are `LANES` of them, or
are joined by new ones, and walk on together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.rays.traversal import MARKS, NUMBERS, marks_of, no_ray, set_marks, set_ray, to_unit, walk_rays
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined
from invgraphics.kernels.numba.simd.lanes import load, store

AHEAD = 16
"""Occupied steps of a ray that are found at once."""
ROW = AHEAD + 1
"""A walk writes one more, of no meaning."""
EDGE = 8
"""Of a block of pixels whose rays a job takes at once."""
BLOCK = EDGE * EDGE
SLOTS = int(POINTS) + 4 * GROUP
"""Room for rays under way. When `LANES` of them are to walk, none is ready for a place, and fewer than twice as many wait."""
READY, WAITING, WALKING, UNUSED, TAKEN = range(5)
"""Lists of slots, and the number of rays that have been taken from the deal."""

_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_ROOM = np.float32(AHEAD)
_1, _2, _3, _4, _5 = (POINTS * index(k) for k in range(1, 6))


class Way(NamedTuple):
    """Rays of a job that are under way, and lists of them.

    Attributes:
        slots: where the ray of each place is kept, -1 for none.
        middles: of the places' steps, distances.
        lines: of the places' rays, origins and directions, number after number.
        which: number of a slot's ray.
        t0: begins of the steps found, `ROW` for each slot.
        t1: their ends.
        kept: how many there are.
        done: how many have been looked at.
        steps: how many of all steps have been walked.
        resume: where the walk goes on.
        light: what is left of it.
        missed: weight that was left out of the ray's picture.
        views: harmonics of the ray's direction.
        lists: slots by what they wait for.
        counts: lengths of the lists, and number of rays that have been taken from the deal.
        walkers: `walking.NUMBERS` of each ray that walks.
        marks: `walking.MARKS` of each.
    """

    slots: np.ndarray
    middles: np.ndarray
    lines: np.ndarray
    which: np.ndarray
    t0: np.ndarray
    t1: np.ndarray
    kept: np.ndarray
    done: np.ndarray
    steps: np.ndarray
    resume: np.ndarray
    light: np.ndarray
    missed: np.ndarray
    views: np.ndarray
    lists: np.ndarray
    counts: np.ndarray
    walkers: np.ndarray
    marks: np.ndarray


@inlined
def no_rays():
    """`POINTS` places, all without a ray."""
    way = Way(
        np.full(POINTS, -1, np.int64), np.zeros(POINTS, np.float32), np.zeros(6 * POINTS, np.float32),
        np.zeros(SLOTS, np.int64),
        # One row more, for lanes that have no ray.
        np.zeros((SLOTS + 1) * ROW, np.float32), np.zeros((SLOTS + 1) * ROW, np.float32),
        np.zeros(SLOTS, np.int64), np.zeros(SLOTS, np.int64),
        np.zeros(SLOTS, np.float32), np.zeros(SLOTS, np.float32), np.zeros(SLOTS, np.float64), np.zeros(SLOTS, np.float32),
        np.zeros(16 * SLOTS, np.float32), np.zeros((UNUSED + 1, SLOTS), np.int64), np.zeros(TAKEN + 1, np.int64),
        np.zeros(NUMBERS * GROUP, np.float32), np.zeros(MARKS * GROUP, np.float32),
    )  # fmt: skip
    for s in range(SLOTS):
        _put(way, UNUSED, s)
    return way


@inlined
def _put(way, name, s):
    way.lists[name, way.counts[name]] = s
    way.counts[name] += 1


@inlined
def _take(way, name):
    way.counts[name] -= 1
    return way.lists[name, way.counts[name]]


@inlined
def _next_ray(way, deal, count):
    """Number of the next ray of the deal, -1 where there is none.

    Jobs take blocks of a picture in turn, `EDGE` by `EDGE` pixels: neighbours meet the same cells and entries, and walk alike.
    """
    job, jobs, width = deal
    across = (width + EDGE - 1) // EDGE
    while True:
        block, pixel = way.counts[TAKEN] // BLOCK * jobs + job, way.counts[TAKEN] % BLOCK
        down = block // across
        if down * EDGE * width >= count:
            return -1
        way.counts[TAKEN] += 1
        column = (block - down * across) * EDGE + pixel % EDGE
        r = (down * EDGE + pixel // EDGE) * width + column
        if column < width and r < count:
            return r


@inlined
def _start(way, deal, start):
    """Take a new ray; returns its slot, -1 where there is none left or no room."""
    r = _next_ray(way, deal, len(start)) if way.counts[UNUSED] > 0 else -1
    if r < 0:
        return -1
    s = _take(way, UNUSED)
    way.which[s], way.kept[s], way.steps[s], way.resume[s] = r, 0, _ZERO, start[r]
    way.light[s], way.missed[s] = 1.0, _ZERO
    return s


@inlined
def view_of(s):
    """Where the harmonics of slot ``s`` begin; they follow one another after `LANES` numbers."""
    return (index(s) // LANES) * index(16) * LANES + index(s) % LANES


@inlined
def _gather(deal, rays, way):
    """Let `LANES` rays get ready to walk: new ones, which are neighbours, unless enough others wait; returns how many."""
    origins, directions, start, far = rays
    n, enough = 0, way.counts[WAITING] >= GROUP
    for lane in range(GROUP):
        s = -1 if enough else _start(way, deal, start)
        if s < 0 and way.counts[WAITING] > 0:
            s = _take(way, WAITING)
        if s < 0:
            # The other lanes stand still, and write to a row of their own.
            no_ray(way.walkers, way.marks, lane, SLOTS * ROW)
            continue
        r, n = way.which[s], n + 1
        way.lists[WALKING, lane] = s
        # The lattice is counted from the ray's start, so that these are the very steps of an ordinary march.
        set_ray(way.walkers, lane, origins, directions, r, start[r], far[r])
        set_marks(way.marks, lane, s * ROW, way.steps[s], way.resume[s])
    return n


@inlined
def _walk_on(deal, rays, space, way):
    """Find the next occupied steps of a few rays; whether there were any rays."""
    n = _gather(deal, rays, way)
    if n > 0:
        walk_rays(way.walkers, way.marks, _ROOM, space, way.t0, way.t1)
    for lane in range(n):
        s = way.lists[WALKING, lane]
        new = way.kept[s] == 0
        way.kept[s], way.steps[s], way.resume[s] = marks_of(way.marks, lane)
        way.done[s] = 0
        if way.kept[s] > 0:
            r = way.which[s]
            if new:
                harmonics((rays[1][r, 0], rays[1][r, 1], rays[1][r, 2]), way.views, view_of(s))
            _put(way, READY, s)
        else:
            _put(way, UNUSED, s)
    return n > 0


@inlined
def _seat(p, deal, rays, space, way):
    """Give place ``p`` another ray, one that has steps to look at; whether there is one."""
    origins, directions, _, far = rays
    s = way.slots[p]
    if s >= 0:
        _put(way, WAITING if way.resume[s] < far[way.which[s]] else UNUSED, s)
        way.slots[p] = -1
    while way.counts[READY] == 0:
        if not _walk_on(deal, rays, space, way):
            return False
    s = _take(way, READY)
    way.slots[p] = s
    for axis in range(3):
        way.lines[index(axis) * POINTS + index(p)] = origins[way.which[s], axis]
        way.lines[index(3 + axis) * POINTS + index(p)] = directions[way.which[s], axis]
    return True


@inlined
def fill(deal, rays, space, way, points):
    """Give every place the next occupied step of a ray, in the unit cube; whether any has one."""
    busy = False
    for p in range(POINTS):
        s = way.slots[p]
        if (s >= 0 and way.done[s] < way.kept[s]) or _seat(p, deal, rays, space, way):
            begin, end = step_of(way, way.slots[p])
            way.middles[p] = (begin + end) * _HALF
            busy = True
    box, contracted = space[0], space[3]
    for part in range(POINTS // LANES):
        at = index(part) * LANES
        t = load(way.middles, at)
        x = load(way.lines, at) + t * load(way.lines, at + _3)
        y = load(way.lines, at + _1) + t * load(way.lines, at + _4)
        z = load(way.lines, at + _2) + t * load(way.lines, at + _5)
        x, y, z = to_unit(box, contracted, x, y, z)
        store(points, at, x)
        store(points, at + _1, y)
        store(points, at + _2, z)
    return busy


@inlined
def step_of(way, s):
    """The step that the ray of slot ``s`` looks at, its begin and end."""
    at = s * ROW + way.done[s]
    return way.t0[at], way.t1[at]


@inlined
def stop(way, s, far):
    """Let the ray of slot ``s`` go no farther."""
    way.done[s], way.resume[s] = way.kept[s], far[way.which[s]]
