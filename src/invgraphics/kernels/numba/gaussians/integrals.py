"""Exact line integrals of overlapping Gaussians: each ray's light. Error functions are evaluated near a Gaussian only."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.gaussians.nodes import place_nodes
from invgraphics.kernels.numba.gaussians.pairs import restrict
from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.runtime import exp2, inlined, parallel, prange
from invgraphics.kernels.reference.gaussian_rays import MAX_DEVIATIONS
from invgraphics.kernels.types import ALPHA_MAX

STRIDE = 16
"""Between the functions that `harmonics` writes."""
CUT = np.float32(5.6)
"""Standard deviations beyond which a normal distribution counts as over: 1e-8 of it is left."""
_EIGHT, _ZERO, _HALF, _ONE = np.float32(MAX_DEVIATIONS), np.float32(0.0), np.float32(0.5), np.float32(1.0)
_ALPHA_MAX = np.float32(ALPHA_MAX)
_LOG2E = np.float32(1 / np.log(2.0))
_HALF_LOG2E = np.float32(0.5 / np.log(2.0))
_ROOT = np.float32(1 / np.sqrt(2 * np.pi))
_THIN = np.float32(np.finfo(np.float32).eps ** 0.5)
# Abramowitz and Stegun 7.1.26, of which |error| <= 1.5e-7: erfc(x) = k (a1 + k (a2 + ...)) exp(-x²), k = 1 / (1 + p x).
_P = np.float32(0.3275911 / np.sqrt(2.0))
_A1, _A2, _A3, _A4, _A5 = (np.float32(a / 2) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))


@inlined
def normal_tail(z, bell):
    """Distribution function of the standard normal at z, where ``bell`` is exp(-z² / 2)."""
    k = _ONE / (_ONE + _P * abs(z))
    tail = k * (_A1 + k * (_A2 + k * (_A3 + k * (_A4 + k * _A5)))) * bell
    return tail if z < _ZERO else _ONE - tail


@inlined
def own_shares(nodes, t, sigma, own, bells):
    """Shares of a Gaussian's mass in the intervals between nodes; returns the first interval that has some, and the end.

    ``bells`` gets exp(-z² / 2) at the nodes from the returned first one to the last one before the end's, both included, which
    are zero where the Gaussian has ended.
    """
    count = len(nodes)
    inverse, low, high = _ONE / sigma, t - CUT * sigma, t + CUT * sigma
    begin = 0
    while begin < count and nodes[begin] <= low:
        begin += 1
    end = begin
    while end < count and nodes[end] < high:
        end += 1
    first, last = max(begin - 1, 0), min(end, count - 1)
    # Values of the distribution at nodes first .. last, kept in ``own`` before they are subtracted.
    bells[first], own[first] = _ZERO, _ZERO
    bells[last], own[last] = _ZERO, _ONE
    for e in range(begin, end):
        z = (nodes[e] - t) * inverse
        bell = exp2(-_HALF_LOG2E * z * z)
        bells[e], own[e] = bell, normal_tail(z, bell)
    for s in range(first, last):
        own[s] = own[s + 1] - own[s]
    own[last] = _ZERO
    return first, last


@inlined
def light_of(totals, light, falls):
    """Light ``T (1 - exp(-x)) / x`` of each interval of optical depth x, and its derivative in x with T held."""
    before = _ZERO
    for s in range(len(totals)):
        x = totals[s]
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
        light[s], falls[s] = reached * share, reached * fall
        before += x


@inlined
def colour_of(sh, g, cx, cy, cz, basis, rgb):
    """Colour of a Gaussian at an offset, before it is cut off at 0; ``basis`` gets the functions. Returns 1 / the distance."""
    inverse = _ONE / np.sqrt(cx * cx + cy * cy + cz * cz)
    harmonics((cx * inverse, cy * inverse, cz * inverse), basis, np.uintp(0))
    for c in range(3):
        value = _HALF
        for k in range(sh.shape[1]):
            value += basis[STRIDE * k] * sh[g, k, c]
        rgb[c] = value
    return inverse


@inlined
def seen_colour(sh, table, g, o, group, stamps, colours, basis):
    """Make row g of ``colours`` the Gaussian's colour from an origin, once for all rays of the ``group`` that share it."""
    if stamps[g] != group:
        stamps[g] = group
        colour_of(sh, g, table[g, 0] - o[0], table[g, 1] - o[1], table[g, 2] - o[2], basis, colours[g])


@inlined
def shares_origin(origins, r, first):
    """Whether a job's ray r has the origin of the ray before it."""
    if r == first:
        return False
    before, now = origins[r - 1], origins[r]
    return now[0] == before[0] and now[1] == before[1] and now[2] == before[2]


@inlined
def all_shares(nodes, stop, t, sigma, depth, begin, end, room):
    """`own_shares` of a ray's Gaussians that begin before ``stop``, and the light of the intervals, in a job's work arrays."""
    shares, bells, limits, lights = room
    totals = lights[0]
    totals[:] = _ZERO
    for p in range(begin, end):
        i = p - begin
        if t[p] - CUT * sigma[p] > stop:
            limits[i, 0], limits[i, 1] = 0, 0
            continue
        first, last = own_shares(nodes, t[p], sigma[p], shares[i], bells[i])
        limits[i, 0], limits[i, 1] = first, last
        for s in range(first, last):
            totals[s] += depth[p] * shares[i, s]
    light_of(totals, lights[1], lights[2])


@inlined
def optical_depths(table, strength, reading, gaussian, begin, end, o, d, t, sigma, depth):
    """Distance, width and optical depth of a ray's Gaussians; returns the interval that they cover.

    ``reading`` tells whether strengths are per length, and whether a Gaussian absorbs its own light.
    """
    low, high = np.float32(np.inf), np.float32(-np.inf)
    for p in range(begin, end):
        g = gaussian[p]
        peak, rate, squared, _, _ = restrict(table, g, o[0], o[1], o[2], d[0], d[1], d[2])
        width = _ONE / np.sqrt(rate)
        response = strength[g] * exp2(-_HALF_LOG2E * squared)
        t[p], sigma[p] = peak, width
        whole = response * width if reading[0] else response
        depth[p] = whole if reading[1] else -np.log1p(-min(whole, _ALPHA_MAX))
        low, high = min(low, peak - _EIGHT * width), max(high, peak + _EIGHT * width)
    return low, high


@parallel
def integrate(rays, primitives, reading, pairs, first_ray, kept, sums, rooms):
    """Sums of weight times (1, colour, distance, normal) for every ray; ``kept`` gets what a backward pass needs."""
    origins, directions, near, far = rays
    table, strength, sh, normals = primitives
    gaussian, starts = pairs
    t, sigma, depth, nodes, stops = kept
    for job in prange(len(first_ray) - 1):
        room = rooms[0][job], rooms[1][job], rooms[2][job], rooms[3][job]
        basis = np.empty(STRIDE * STRIDE, np.float32)
        stamps, colours, group = rooms[6][job], rooms[7][job], np.int32(0)
        for r in range(first_ray[job], first_ray[job + 1]):
            group += np.int32(not shares_origin(origins, r, first_ray[job]))
            begin, end = starts[r], starts[r + 1]
            if begin == end:
                continue
            o, d = origins[r], directions[r]
            low, high = optical_depths(table, strength, reading, gaussian, begin, end, o, d, t, sigma, depth)
            low = max(low, near[r])
            high = max(min(high, far[r]), low)
            stops[r] = place_nodes(t, sigma, depth, begin, end, low, high, nodes[r], rooms[4][job], rooms[5][job])
            all_shares(nodes[r], stops[r], t, sigma, depth, begin, end, room)
            light = room[3][1]
            for p in range(begin, end):
                g, own = gaussian[p], room[0][p - begin]
                if room[2][p - begin, 0] == room[2][p - begin, 1]:
                    continue
                weight, drop = _ZERO, _ZERO
                for s in range(room[2][p - begin, 0], room[2][p - begin, 1]):
                    weight += light[s] * own[s]
                weight *= depth[p]
                seen_colour(sh, table, g, o, group, stamps, colours, basis)
                sums[r, 0] += weight
                for c in range(3):
                    sums[r, 1 + c] += weight * max(colours[g, c], _ZERO)
                if sums.shape[1] > 4:
                    # ∫ t over a piece of a normal distribution: t* times its mass minus sigma times the drop of its density.
                    bells = room[1][p - begin]
                    for s in range(room[2][p - begin, 0], room[2][p - begin, 1]):
                        drop += light[s] * (bells[s + 1] - bells[s])
                    sums[r, 4] += t[p] * weight - sigma[p] * depth[p] * drop * _ROOT
                if sums.shape[1] > 5:
                    away = normals[g, 0] * d[0] + normals[g, 1] * d[1] + normals[g, 2] * d[2] > _ZERO
                    for c in range(3):
                        sums[r, 5 + c] += -weight * normals[g, c] if away else weight * normals[g, c]
