"""Occupancy-grid traversal of `LANES` rays at a time in SIMD registers, with empty-space skipping.

In plain IEEE arithmetic, operation for operation what `invgraphics.kernels.reference.march` does in float32, so that both keep
the same intervals; but empty space is skipped, cell by cell near occupied cells, many blocks of cells at once farther away.
Step and cell indices are whole numbers in float32, which is exact up to 2^24.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, exact, index
from invgraphics.kernels.numba.simd.lanes import any_of, broadcast, gather_int8, load, scatter, store, where

MARGIN = np.float32(1e-2)
"""Fraction of a step by which a skip over an empty cell ends early, so that rounding never skips into the next cell."""
ROUNDING = np.float32(1e-6)
"""Several times the relative rounding error of a float32."""
NEARLY_HALF = np.float32(0.49)
"""Half a step, from its midpoint to its end, less the largest rounding error of a skip."""

OCCUPIED = -1
"""Value of occupied cells in the distance map (see `march.traversal_setup`)."""
RAY_FLOATS = 8
"""Per ray, in structure-of-arrays order: origin, direction, start and far distance."""
STATE_FLOATS = 4
"""March state per ray: output row, number of intervals written, lattice index of the next step, current distance."""
_1, _2, _3, _4, _5, _6, _7 = (LANES * index(k) for k in range(1, RAY_FLOATS))
_0 = index(0)

_PARALLEL = np.float32(1e-20)
"""Directions with less than this along an axis count as parallel to its walls."""
_ZERO, _ONE, _TWO = (np.float32(value) for value in (0.0, 1.0, 2.0))
_NEVER = np.float32(np.inf)


@exact
def to_unit(box, contracted, x, y, z):
    """`Bounds.to_unit` of `LANES` positions; ``box`` holds its centre and half edges."""
    x, y, z = (x - box[0]) / box[3], (y - box[1]) / box[4], (z - box[2]) / box[5]
    if contracted:
        squared = x * x + y * y + z * z
        outside, norm = squared > _ONE, np.sqrt(squared)
        scale = _TWO - _ONE / norm
        x = where(outside, scale * (x / norm), x) / _TWO
        y = where(outside, scale * (y / norm), y) / _TWO
        z = where(outside, scale * (z / norm), z) / _TWO
    return (x + _ONE) / _TWO, (y + _ONE) / _TWO, (z + _ONE) / _TWO


@exact
def _step_length(box, direction, step, x, y, z):
    """`reference.march.step_lengths` of contracted steps that begin at `LANES` positions."""
    x, y, z = (x - box[0]) / box[3], (y - box[1]) / box[4], (z - box[2]) / box[5]
    u, v, w = direction[0] / box[3], direction[1] / box[4], direction[2] / box[5]
    squared = x * x + y * y + z * z
    outside, squared = squared > _ONE, max(squared, _ONE)
    speed, along = u * u + v * v + w * w, x * u + y * v + z * w
    radial, across = along * along / squared, _TWO * np.sqrt(squared) - _ONE
    scaled = radial + max(speed - radial, _ZERO) * (across * across)
    return where(outside, step * (squared * np.sqrt(speed / scaled)), step)


@exact
def _inside(unit):
    """Mask of positions in the unit cube."""
    x, y, z = unit
    return (x >= _ZERO) & (y >= _ZERO) & (z >= _ZERO) & (x <= _ONE) & (y <= _ONE) & (z <= _ONE)


@exact
def _cell(unit, resolution):
    return min(max(np.floor(unit * resolution), _ZERO), resolution - _ONE)


@exact
def _wall_distance(unit, first, cells, cell, inverse):
    """Slab test on one axis: distance along the ray to the exit wall of ``cells`` cells from ``first`` on.

    ``cell`` is a cell's edge in the unit cube, ``inverse`` see `_inverse_direction`.
    """
    return (where(inverse > _ZERO, first + cells, first) * cell - unit) * inverse


@exact
def _aligned(x, edge, distance):
    """First cell, on one axis, of the blocks less than ``distance`` blocks away from a cell's own."""
    return (np.floor(x / edge) - distance + _ONE) * edge


@exact
def _inverse_direction(direction, half):
    """Inverse direction on one axis, in ray distance per unit of the unit cube; huge where the ray is parallel to the walls."""
    huge = _TWO * half / _PARALLEL
    straight = where(direction < _ZERO, -huge, huge)
    return where(abs(direction) > _PARALLEL, _TWO * half / direction, straight)


@exact
def set_ray(rays, lane, origins, directions, r, first, far):
    """Load ray ``r`` into a lane."""
    at = index(lane)
    for axis in range(3):
        rays[at + index(axis) * LANES] = origins[r, axis]
        rays[at + index(3 + axis) * LANES] = directions[r, axis]
    rays[at + _6], rays[at + _7] = first, far


@exact
def set_state(state, lane, row, steps, t):
    """Initialise a march state: output from ``row`` on, no interval yet, at lattice index ``steps`` and distance ``t``."""
    at = index(lane)
    state[at], state[at + _1], state[at + _2], state[at + _3] = row, _ZERO, steps, t


@exact
def idle_lane(rays, state, lane, row):
    """Deactivate a lane; it still writes to ``row``."""
    rays[index(lane) + _7] = -_NEVER
    set_state(state, lane, row, _ZERO, _ZERO)


@exact
def read_state(state, lane):
    """Number of intervals a lane has written, lattice index of its next step, and its distance."""
    at = index(lane)
    return np.int64(state[at + _1]), state[at + _2], state[at + _3]


@exact
def _position(rays, t):
    """World positions on the rays at ``t``."""
    x, y, z = load(rays, _0), load(rays, _1), load(rays, _2)
    return x + t * load(rays, _3), y + t * load(rays, _4), z + t * load(rays, _5)


@exact
def _inverse_directions(rays, box):
    """`_inverse_direction` on all three axes."""
    x, y, z = load(rays, _3), load(rays, _4), load(rays, _5)
    return _inverse_direction(x, box[3]), _inverse_direction(y, box[4]), _inverse_direction(z, box[5])


@exact
def _skip_distance(unit, cells, distance, grid, inverse):
    """Distance along the rays to the exit of the empty region around their cells.

    ``distance`` is the distance map's value; ``grid`` holds the cells along an edge of the cube and of a block.
    """
    (ux, uy, uz), (x, y, z), (inverse_x, inverse_y, inverse_z) = unit, cells, inverse
    cell, edge = _ONE / grid[0], grid[1]
    # All blocks less than ``distance`` away are empty, on every side.
    wide = distance > _ZERO
    count = where(wide, (_TWO * distance - _ONE) * edge, _ONE)
    x, y = where(wide, _aligned(x, edge, distance), x), where(wide, _aligned(y, edge, distance), y)
    z = where(wide, _aligned(z, edge, distance), z)
    exit_distance = min(_wall_distance(ux, x, count, cell, inverse_x), _wall_distance(uy, y, count, cell, inverse_y))
    return min(exit_distance, _wall_distance(uz, z, count, cell, inverse_z))


@exact
def march_rays(rays, state, limit, setup, t0, t1):
    """Occupied intervals of `LANES` rays, each marched until its far end or until it has ``limit`` of them.

    Args:
        rays: `RAY_FLOATS` x `LANES`, flat; idle lanes have far = -inf.
        state: `STATE_FLOATS` x `LANES`, flat, updated in place. A row has space for one interval more, of no meaning.
        limit: maximum number of intervals (float32).
        setup: see `march.traversal_setup`.
        t0: interval starts, flat.
        t1: interval ends, flat.
    """
    box, distances, shift, contracted, step, cone, uniform = setup
    grid = np.float32(distances.shape[0]), np.float32(1 << shift)
    inverse, per_step = _inverse_directions(rays, box), _ONE / step
    first, far = load(rays, _6), load(rays, _7)
    row, count, steps, t = load(state, _0), load(state, _1), load(state, _2), load(state, _3)
    empty_until = broadcast(-_NEVER)
    active = (t < far) & (count < limit)
    while any_of(active):
        # Without a cone the lattice is counted from the first step, so that skipping steps changes no bit of the others.
        after = first + (steps + _ONE) * step if cone == _ZERO else t + max(cone * t, step)
        if uniform:
            x, y, z = _position(rays, t)
            direction = load(rays, _3), load(rays, _4), load(rays, _5)
            after = t + _step_length(box, direction, step, x, y, z)
        # Otherwise the step is lost to rounding, or not a number, and the march ends.
        moving = active & (after > t)
        end = min(after, far)
        midpoint = (t + end) / _TWO
        tested = moving & (midpoint >= empty_until)
        if any_of(tested):
            x, y, z = _position(rays, midpoint)
            unit = to_unit(box, contracted, x, y, z)
            cells = _cell(unit[0], grid[0]), _cell(unit[1], grid[0]), _cell(unit[2], grid[0])
            distance, valid = gather_int8(distances, cells[0], cells[1], cells[2]), tested & _inside(unit)
            found = valid & (distance < _ZERO)
            if any_of(found):
                scatter(t0, row + count, t)
                scatter(t1, row + count, end)
                count = where(found, count + _ONE, count)
            if not contracted:
                empty = valid & (distance >= _ZERO)
                exit_distance = _skip_distance(unit, cells, distance, grid, inverse)
                empty_until = where(empty, min(midpoint + exit_distance - MARGIN * (end - t), far), empty_until)
                if cone == _ZERO and not uniform:
                    # To the first step whose midpoint is past the wall, or the one before; ``tested`` decides.
                    error = ROUNDING * (abs(first) + abs(empty_until))
                    target = np.floor((empty_until - first - error) * per_step + NEARLY_HALF)
                    skipping = empty & (target > steps + _ONE)
                    steps = where(skipping, target - _ONE, steps)
                    end = where(skipping, min(first + target * step, far), end)
        steps = where(moving, steps + _ONE, steps)
        t = where(moving, end, where(active, far, t))
        active = (t < far) & (count < limit)
    store(state, _1, count)
    store(state, _2, steps)
    store(state, _3, t)
