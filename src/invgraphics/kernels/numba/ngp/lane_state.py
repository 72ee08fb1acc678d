"""State of sphere-traced rays, each in a batch lane: a step of all that march, in registers; refinements of single ones.

Judged by `invgraphics.kernels.reference.tracing`, whose rows of state are the first of these.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.runtime import LANES, index, inlined
from invgraphics.kernels.numba.simd.lanes import broadcast, load, store, where
from invgraphics.kernels.reference.tracing import GOLDEN, ROUNDING

_T, _F, LOW, LOW_T, LOW_A, LOW_B, _HIT_A, _HIT_FA, _HIT_B, _HIT_FB, NEXT = range(11)
RESULTS = 11
"""Rows of the reference's state: what is left of a ray at its end."""
_ORIGIN, _DIRECTION = 11, 14
"""First of three rows each, in the unit cube."""
_FAR, _MARCHING, STEPS, STOPPED, ENDED = range(17, 22)
"""End of the ray; whether it marches; its look-ups; whether it has stopped marching, and for another reason than those."""
ROWS = 22

_ZERO, _HALF, _ONE, _INFINITE = (np.float32(value) for value in (0, 0.5, 1, np.inf))
_GOLDEN, _ROUNDING = np.float32(GOLDEN), np.float32(ROUNDING)


@inlined
def begin_ray(state, p, ray, box):
    """Begin a ray, given by its origin, direction, near and far, in lane ``p``; it looks first where it begins."""
    origin, direction, near, far = ray
    lo, inverse = box
    for row in range(RESULTS):
        state[row, p] = _INFINITE
    state[_T, p] = state[LOW_T, p] = state[LOW_A, p] = state[NEXT, p] = near
    state[_F, p] = _ZERO
    for axis in range(3):
        state[_ORIGIN + axis, p] = (origin[axis] - lo[axis]) * inverse[axis]
        state[_DIRECTION + axis, p] = direction[axis] * inverse[axis]
    state[_FAR, p], state[_MARCHING, p], state[STEPS, p], state[STOPPED, p] = far, _ONE, _ZERO, _ZERO


@inlined
def _row(number, at):
    return index(number) * POINTS + at


@inlined
def next_positions(state, points):
    """Write where all lanes look next, in the unit cube; both arrays are flat."""
    for half in range(2):
        at = index(half) * LANES
        t = load(state, _row(NEXT, at))
        for axis in range(3):
            store(points, _row(axis, at), load(state, _row(_ORIGIN + axis, at)) + t * load(state, _row(_DIRECTION + axis, at)))


@inlined
def _flag(condition):
    return where(condition, broadcast(_ONE), broadcast(_ZERO))


@inlined
def _take(state, row, at, condition, value):
    """Replace a row's values in the lanes where the condition holds."""
    store(state, _row(row, at), where(condition, value, load(state, _row(row, at))))


@inlined
def march(state, at, value, limits):
    """Take the distances ``value`` into the `LANES` lanes from ``at`` on, in those that march; ``state`` is flat."""
    most, relaxation, least, depth = np.float32(limits[0]), limits[1], limits[3], limits[5]
    t, before_t, before = load(state, _row(NEXT, at)), load(state, _row(_T, at)), load(state, _row(_F, at))
    low, low_t, bracket = load(state, _row(LOW, at)), load(state, _row(LOW_T, at)), load(state, _row(_HIT_B, at))
    marching, later = load(state, _row(_MARCHING, at)) > _ZERO, low < _INFINITE
    safe, jump = max(abs(before), least), t - before_t
    relaxed = (before > _ZERO) & (jump - safe > _ROUNDING * (t + safe))
    accepted = marching & ~(later & relaxed & (abs(value) + before < jump))
    crosses = accepted & (value <= _ZERO) & (bracket >= _INFINITE)
    _take(state, _HIT_A, at, crosses, where(later, before_t, t))
    _take(state, _HIT_FA, at, crosses, where(later, before, value))
    _take(state, _HIT_B, at, crosses, t)
    _take(state, _HIT_FB, at, crosses, value)
    lower, follows = accepted & (value < low), accepted & later & (low_t >= before_t) & (low_t <= before_t)
    _take(state, LOW_B, at, lower | follows, t)
    _take(state, LOW, at, lower, value)
    _take(state, LOW_T, at, lower, t)
    _take(state, LOW_A, at, lower, before_t)
    step = max(where(value > _ZERO, relaxation * value, max(-value, depth)), least)
    reached, distance = where(accepted, t, before_t), where(accepted, value, before)
    far, following = load(state, _row(_FAR, at)), where(accepted, t + step, before_t + safe)
    _take(state, _T, at, marching, reached)
    _take(state, _F, at, marching, distance)
    _take(state, NEXT, at, marching, min(following, far))
    # A step ends a ray only as far as its sphere reaches: behind that, an over-relaxed one has to be looked at first.
    ended = (distance < -depth) | (reached + max(abs(distance), least) > far) | (reached >= far)
    steps = load(state, _row(STEPS, at)) + _flag(marching)
    store(state, _row(STEPS, at), steps)
    _take(state, ENDED, at, marching, _flag(ended))
    store(state, _row(STOPPED, at), _flag(marching & (ended | (steps >= most))))


@inlined
def stop_marching(state, p):
    """Leave lane ``p`` out of `march`."""
    state[_MARCHING, p] = state[STOPPED, p] = _ZERO


@inlined
def marches(state, p):
    """Whether lane ``p`` goes on marching."""
    return state[_MARCHING, p] > state[STOPPED, p]


@inlined
def begin_hit(state, p, limits):
    """Look next at the false position of a hit that is not exact yet; returns whether it has to be refined."""
    b = state[_HIT_B, p]
    if b == _INFINITE or abs(state[_HIT_FB, p]) <= limits[4] or state[_HIT_A, p] == b:
        return False
    share = state[_HIT_FB, p] / (state[_HIT_FB, p] - state[_HIT_FA, p])
    state[NEXT, p] = b + (state[_HIT_A, p] - b) * share
    return True


@inlined
def take_hit(state, p, value):
    """Take a distance into the bracket of a hit (Illinois)."""
    if value * state[_HIT_FB, p] < _ZERO:
        state[_HIT_A, p], state[_HIT_FA, p] = state[_HIT_B, p], state[_HIT_FB, p]
    else:
        state[_HIT_FA, p] *= _HALF
    state[_HIT_B, p], state[_HIT_FB, p] = state[NEXT, p], value


@inlined
def begin_closest(state, p, limits):
    """Look next at the golden section of the closest approach; returns whether it has to be refined."""
    a, m, b = state[LOW_A, p], state[LOW_T, p], state[LOW_B, p]
    if not (abs(state[LOW, p]) < limits[5] and b < _INFINITE and b > m > a):
        return False
    state[NEXT, p] = m + _GOLDEN * (b - m if b - m > m - a else a - m)
    return True


@inlined
def take_closest(state, p, value):
    """Take a distance into the bracket of a closest approach."""
    t, m = state[NEXT, p], state[LOW_T, p]
    if value < state[LOW, p]:
        if t > m:
            state[LOW_A, p] = m
        else:
            state[LOW_B, p] = m
        state[LOW, p], state[LOW_T, p] = value, t
    elif t > m:
        state[LOW_B, p] = t
    else:
        state[LOW_A, p] = t
