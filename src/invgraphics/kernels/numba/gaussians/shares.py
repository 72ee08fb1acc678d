"""Shares of Gaussians in the intervals of a ray, and the light of these: `LANES` intervals at once."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined
from invgraphics.kernels.numba.simd.lanes import exp2_of, load, store, where
from invgraphics.kernels.numba.simd.shifts import first_lane, shift_in

CUT = np.float32(5.6)
"""Standard deviations beyond which a normal distribution counts as over: 1e-8 of it is left."""
ROWS = 3
"""Rows of a Gaussian: differences, over each interval, of its distribution function Φ, of φ / φ(0), and of z φ / φ(0)."""
TOTALS, LIGHT, FALLS, WANTED, SLOPES = (index(row) for row in range(5))
"""Rows of a ray's intervals: optical depths, light and its derivative, and gradients in light and in optical depths."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LOG2E = np.float32(1 / np.log(2.0))
_HALF_LOG2E = np.float32(0.5 / np.log(2.0))
_THIN = np.float32(np.finfo(np.float32).eps ** 0.5)
# Abramowitz and Stegun 7.1.26, of which |error| <= 1.5e-7: erfc(x) = k (a1 + k (a2 + ...)) exp(-x²), k = 1 / (1 + p x).
_P = np.float32(0.3275911 / np.sqrt(2.0))
_A1, _A2, _A3, _A4, _A5 = (np.float32(a / 2) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))


@inlined
def lower_tail(z, bell):
    """Distribution function of the standard normal at -|z|, where ``bell`` is exp(-z² / 2); scalar or SIMD register."""
    k = _ONE / (_ONE + _P * abs(z))
    return k * (_A1 + k * (_A2 + k * (_A3 + k * (_A4 + k * _A5)))) * bell


@inlined
def normal_distribution(z):
    """Distribution function of the standard normal at a number z, and exp(-z² / 2)."""
    if abs(z) >= CUT:
        return (_ZERO if z < _ZERO else _ONE), _ZERO
    bell = exp2(-_HALF_LOG2E * z * z)
    tail = lower_tail(z, bell)
    return (tail if z < _ZERO else _ONE - tail), bell


@inlined
def own_shares(nodes, first, registers, t, sigma, sloped, rows, place):
    """Store `ROWS` of a Gaussian, only the first one unless ``sloped``; returns the registers of intervals that it reaches.

    Args:
        nodes: of all rays, flat; edges of this ray's intervals are those from ``first`` on.
        registers: of `LANES` intervals each, that a ray has.
        rows: flat, of `LANES` times ``registers`` columns; those of this Gaussian begin at ``place``.

    Returns:
        The first register, and the one after the last.
    """
    inverse, low, high = _ONE / sigma, t - CUT * sigma, t + CUT * sigma
    begin = index(0)
    while begin < registers and nodes[first + LANES * (begin + index(1))] <= low:
        begin += index(1)
    end = begin
    while end < registers and nodes[first + LANES * end] < high:
        end += index(1)
    z_after = (nodes[first + LANES * end] - t) * inverse
    after, bell_after = normal_distribution(z_after)
    moment_after = z_after * bell_after if bell_after > _ZERO else _ZERO
    width = LANES * registers
    for k in range(end - begin):
        at = LANES * (end - index(1) - k)
        z = (load(nodes, first + at) - t) * inverse
        z = where(abs(z) < CUT, z, where(z < _ZERO, -CUT, CUT))
        bell = where(abs(z) < CUT, exp2_of(-_HALF_LOG2E * z * z), _ZERO)
        tail = lower_tail(z, bell)
        value = where(z < _ZERO, tail, _ONE - tail)
        store(rows, place + at, shift_in(value, after) - value)
        after = first_lane(value)
        if sloped:
            moment = z * bell
            store(rows, place + width + at, shift_in(bell, bell_after) - bell)
            store(rows, place + width + width + at, shift_in(moment, moment_after) - moment)
            bell_after, moment_after = first_lane(bell), first_lane(moment)
    return begin, end


@inlined
def light_of(lights):
    """Fill in the light ``T (1 - exp(-x)) / x`` of each interval of optical depth x, and its derivative in x with T held."""
    before = _ZERO
    for s in range(lights.shape[1]):
        x = lights[TOTALS, s]
        reached = exp2(-min(before, np.float32(80.0)) * _LOG2E)
        if x < _THIN:
            share, fall = _ONE - _HALF * x, np.float32(1 / 3) * x - _HALF
        elif x < np.float32(0.05):
            share = _ONE - x * (_HALF - x * (np.float32(1 / 6) - x * np.float32(1 / 24)))
            fall = -_HALF + x * (np.float32(1 / 3) - x * (np.float32(1 / 8) - x * np.float32(1 / 30)))
        else:
            through = exp2(-min(x, np.float32(80.0)) * _LOG2E)
            share = (_ONE - through) / x
            fall = (through - share) / x
        lights[LIGHT, s], lights[FALLS, s] = reached * share, reached * fall
        before += x


@inlined
def all_shares(nodes, first, stop, gaussians, pairs, sloped, room):
    """`own_shares` of a ray's Gaussians that begin before ``stop``, and the light of the intervals, in a job's work arrays.

    Args:
        gaussians: distance, width and optical depth of each pair.
        pairs: the ray's first one, and the next ray's.
        room: rows of Gaussians (flat), their first and last registers, and rows of the ray's intervals, also as a flat array.
    """
    t, sigma, depth = gaussians
    begin, end = pairs
    rows, limits, lights, flat = room
    registers = index(lights.shape[1]) // LANES
    lights[TOTALS] = _ZERO
    stride = index(ROWS) * LANES * registers
    for p in range(begin, end):
        i = p - begin
        limits[i, 0], limits[i, 1] = 0, 0
        if t[p] - CUT * sigma[p] > stop:
            continue
        place = index(i) * stride
        low, high = own_shares(nodes, first, registers, t[p], sigma[p], sloped, rows, place)
        for q in range(low, high):
            store(flat, LANES * q, load(flat, LANES * q) + depth[p] * load(rows, place + LANES * q))
        limits[i, 0], limits[i, 1] = low, high
    light_of(lights)
