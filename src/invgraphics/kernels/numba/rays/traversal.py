"""Walking along rays through an occupancy grid, `LANES` of them side by side.

In plain IEEE arithmetic, operation for operation what `invgraphics.kernels.reference.march` does in float32, so that both keep
the same intervals; but empty space is leapt over: a cell at a time near what is occupied, many blocks of cells farther away.
Numbers of steps and cells are whole numbers in float32, which holds all of them up to 2^24.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, exact, index
from invgraphics.kernels.numba.simd.lanes import any_of, load, look_up, put, spread, store, where

MARGIN = np.float32(1e-2)
"""Share of a step by which a leap over an empty cell ends early, so that rounding never leaps into the next cell."""
ROUNDING = np.float32(1e-6)
"""Several times the relative rounding error of a float32."""
NEARLY_HALF = np.float32(0.49)
"""Steps from a step's middle to its end, less what a leap may be too short by."""

OCCUPIED = -1
"""What a map of the ways says of occupied cells (see `march.surroundings`)."""
NUMBERS = 8
"""Of each ray: origin, direction, where it began and where it ends."""
MARKS = 4
"""Of each ray under way: where its intervals are written, how many are, steps taken, and where it is."""
_1, _2, _3, _4, _5, _6, _7 = (LANES * index(k) for k in range(1, NUMBERS))
_START = index(0)

_PARALLEL = np.float32(1e-20)
"""Directions with less than this along an axis never reach a wall on it."""
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
    """Whether positions lie in the unit cube."""
    x, y, z = unit
    return (x >= _ZERO) & (y >= _ZERO) & (z >= _ZERO) & (x <= _ONE) & (y <= _ONE) & (z <= _ONE)


@exact
def _cell(unit, resolution):
    return min(max(np.floor(unit * resolution), _ZERO), resolution - _ONE)


@exact
def _way_out(unit, first, cells, cell, pace):
    """Distance along the ray to the far wall, on one axis, of ``cells`` cells from ``first`` on.

    ``cell`` is a cell's edge in the unit cube, ``pace`` the distance along the ray per unit on this axis.
    """
    return (where(pace > _ZERO, first + cells, first) * cell - unit) * pace


@exact
def _aligned(x, edge, gap):
    """First cell, on one axis, of the blocks less than ``gap`` away from a cell's own."""
    return (np.floor(x / edge) - gap + _ONE) * edge


@exact
def _pace(direction, half):
    """Distance along the ray per unit on one axis of the unit cube; next to endless where parallel."""
    endless = _TWO * half / _PARALLEL
    straight = where(direction < _ZERO, -endless, endless)
    return where(abs(direction) > _PARALLEL, _TWO * half / direction, straight)


@exact
def set_ray(lines, lane, origins, directions, r, first, far):
    """Let a lane walk along ray ``r``."""
    at = index(lane)
    for axis in range(3):
        lines[at + index(axis) * LANES] = origins[r, axis]
        lines[at + index(3 + axis) * LANES] = directions[r, axis]
    lines[at + _6], lines[at + _7] = first, far


@exact
def set_marks(marks, lane, row, taken, t):
    """Have a lane write from ``row`` on; its ray is at ``t`` after so many steps."""
    at = index(lane)
    marks[at], marks[at + _1], marks[at + _2], marks[at + _3] = row, _ZERO, taken, t


@exact
def no_ray(lines, marks, lane, row):
    """Let a lane stand still; it needs a row all the same."""
    lines[index(lane) + _7] = -_NEVER
    set_marks(marks, lane, row, _ZERO, _ZERO)


@exact
def marks_of(marks, lane):
    """How many intervals a lane has kept, after how many steps, and where it is."""
    at = index(lane)
    return np.int64(marks[at + _1]), marks[at + _2], marks[at + _3]


@exact
def _position(lines, t):
    """Where rays are at ``t``, in the scene."""
    x, y, z = load(lines, _START), load(lines, _1), load(lines, _2)
    return x + t * load(lines, _3), y + t * load(lines, _4), z + t * load(lines, _5)


@exact
def _paces(lines, box):
    """`_pace` on all three axes."""
    return _pace(load(lines, _3), box[3]), _pace(load(lines, _4), box[4]), _pace(load(lines, _5), box[5])


@exact
def _way_through(unit, cells, gap, grid, paces):
    """Distance along rays to the end of what is known to be empty around a cell.

    ``gap`` is what the map says of it; ``grid`` holds the numbers of cells along an edge of the cube and of a block.
    """
    (ux, uy, uz), (x, y, z), (pace_x, pace_y, pace_z) = unit, cells, paces
    cell, edge = _ONE / grid[0], grid[1]
    # All blocks less than ``gap`` away are empty too, on every side.
    wide = gap > _ZERO
    count = where(wide, (_TWO * gap - _ONE) * edge, _ONE)
    x, y = where(wide, _aligned(x, edge, gap), x), where(wide, _aligned(y, edge, gap), y)
    z = where(wide, _aligned(z, edge, gap), z)
    out = min(_way_out(ux, x, count, cell, pace_x), _way_out(uy, y, count, cell, pace_y))
    return min(out, _way_out(uz, z, count, cell, pace_z))


@exact
def walk_rays(lines, marks, room, space, t0, t1):
    """Keep intervals of `LANES` rays, each until it ends or has kept ``room`` of them.

    Args:
        lines: `NUMBERS` of each ray, number after number; a lane without a ray ends before it begins.
        marks: `MARKS` of each ray, which are brought up to date. A row has room for one interval more, of no meaning.
        room: most intervals (float32).
        space: see `march.surroundings`.
        t0: begins of intervals, flat.
        t1: their ends.
    """
    box, ways, shift, contracted, step, cone, even = space
    grid = np.float32(ways.shape[0]), np.float32(1 << shift)
    paces, per_step = _paces(lines, box), _ONE / step
    first, far = load(lines, _6), load(lines, _7)
    row, kept, taken, t = load(marks, _START), load(marks, _1), load(marks, _2), load(marks, _3)
    free = spread(-_NEVER)
    going = (t < far) & (kept < room)
    while any_of(going):
        # Without a cone the lattice is counted from the first step, so that leaping over steps changes no bit of the rest.
        after = first + (taken + _ONE) * step if cone == _ZERO else t + max(cone * t, step)
        if even:
            x, y, z = _position(lines, t)
            direction = load(lines, _3), load(lines, _4), load(lines, _5)
            after = t + _step_length(box, direction, step, x, y, z)
        # Otherwise the step is lost to rounding, or not a number, and the walk ends.
        moving = going & (after > t)
        end = min(after, far)
        middle = (t + end) / _TWO
        looking = moving & (middle >= free)
        if any_of(looking):
            x, y, z = _position(lines, middle)
            unit = to_unit(box, contracted, x, y, z)
            cells = _cell(unit[0], grid[0]), _cell(unit[1], grid[0]), _cell(unit[2], grid[0])
            gap, here = look_up(ways, cells[0], cells[1], cells[2]), looking & _inside(unit)
            found = here & (gap < _ZERO)
            if any_of(found):
                put(t0, row + kept, t)
                put(t1, row + kept, end)
                kept = where(found, kept + _ONE, kept)
            if not contracted:
                empty = here & (gap >= _ZERO)
                out = _way_through(unit, cells, gap, grid, paces)
                free = where(empty, min(middle + out - MARGIN * (end - t), far), free)
                if cone == _ZERO:
                    # To the first step whose middle is past the wall, or the one before; the comparison settles it.
                    error = ROUNDING * (abs(first) + abs(free))
                    leap = np.floor((free - first - error) * per_step + NEARLY_HALF)
                    leaping = empty & (leap > taken + _ONE)
                    taken = where(leaping, leap - _ONE, taken)
                    end = where(leaping, min(first + leap * step, far), end)
        taken = where(moving, taken + _ONE, taken)
        t = where(moving, end, where(going, far, t))
        going = (t < far) & (kept < room)
    store(marks, _1, kept)
    store(marks, _2, taken)
    store(marks, _3, t)
