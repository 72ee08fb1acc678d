"""Exact line integrals of overlapping Gaussians: each ray's light."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.gaussians.nodes import place_nodes
from invgraphics.kernels.numba.gaussians.pairs import restrict
from invgraphics.kernels.numba.gaussians.shares import LIGHT, ROWS, all_shares
from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.lanes import broadcast, load, reduce_sum
from invgraphics.kernels.numba.simd.partial import unowned
from invgraphics.kernels.reference.gaussian_rays import MAX_DEVIATIONS
from invgraphics.kernels.types import ALPHA_MAX

STRIDE = 16
"""Between the functions that `harmonics` writes."""
_EIGHT, _ZERO, _HALF, _ONE = np.float32(MAX_DEVIATIONS), np.float32(0.0), np.float32(0.5), np.float32(1.0)
_ALPHA_MAX = np.float32(ALPHA_MAX)
_HALF_LOG2E = np.float32(0.5 / np.log(2.0))
_ROOT = np.float32(1 / np.sqrt(2 * np.pi))
_SHORTEST = np.float32(1e-12)
"""Length up to which vectors are divided by this instead of their length, as in torch's ``normalize``."""


@inlined
def colour_of(sh, g, cx, cy, cz, basis, rgb):
    """Colour of a Gaussian at an offset, before it is cut off at 0; ``basis`` gets the functions. Returns 1 / the distance."""
    inverse = _ONE / max(np.sqrt(cx * cx + cy * cy + cz * cz), _SHORTEST)
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
def optical_depths(table, strength, reading, gaussian, begin, end, o, d, t, sigma, depth):
    """Distance, width and optical depth of a ray's Gaussians; returns the interval that they cover.

    ``reading``: whether strengths are per length, and whether a Gaussian absorbs its own light.
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


@inlined
def _add_light(sums, r, weight, rgb):
    """Add a weight times (1, colour) to a ray's sums."""
    sums[r, 0] += weight
    for c in range(3):
        sums[r, 1 + c] += weight * max(rgb[c], _ZERO)


@inlined
def _add_normal(sums, r, weight, normals, g, d):
    """Add a weight times the normal, turned against the ray, to a ray's sums."""
    away = normals[g, 0] * d[0] + normals[g, 1] * d[1] + normals[g, 2] * d[2] > _ZERO
    for c in range(3):
        sums[r, 5 + c] += -weight * normals[g, c] if away else weight * normals[g, c]


@parallel
def integrate(rays, primitives, reading, pairs, first_ray, steps, kept, sums, rooms):
    """Sums of weight times (1, colour, distance, normal) for every ray; ``kept`` gets what a backward pass needs."""
    origins, directions, near, far = rays
    table, strength, sh, normals = primitives
    gaussian, starts = pairs
    t, sigma, depth, nodes, stops = kept
    edges = index(nodes.shape[1])
    width, sloped = edges - index(1), sums.shape[1] > 4
    for job in prange(len(first_ray) - 1):
        rows, limits, lights = unowned(rooms[0][job]), rooms[1][job], unowned(rooms[2][job])
        room = rows, limits, rooms[2][job], lights
        basis = np.empty(STRIDE * STRIDE, np.float32)
        stamps, colours, group = rooms[5][job], rooms[6][job], np.int32(0)
        for r in range(first_ray[job], first_ray[job + 1]):
            group += np.int32(not shares_origin(origins, r, first_ray[job]))
            begin, end = starts[r], starts[r + 1]
            if begin == end:
                continue
            o, d = origins[r], directions[r]
            low, high = optical_depths(table, strength, reading, gaussian, begin, end, o, d, t, sigma, depth)
            low = max(low, near[r])
            high = max(min(high, far[r]), low)
            stops[r] = place_nodes(t, sigma, depth, begin, end, low, high, steps, nodes[r], rooms[3][job], rooms[4][job])
            all_shares(unowned(nodes), index(r) * edges, stops[r], (t, sigma, depth), (begin, end), sloped, room)
            for p in range(begin, end):
                i, g = p - begin, gaussian[p]
                if limits[i, 0] == limits[i, 1]:
                    continue
                place, weights, drops = index(ROWS) * width * index(i), broadcast(_ZERO), broadcast(_ZERO)
                for q in range(limits[i, 0], limits[i, 1]):
                    light = load(lights, LIGHT * width + LANES * q)
                    weights += light * load(rows, place + LANES * q)
                    if sloped:
                        drops += light * load(rows, place + width + LANES * q)
                weight = reduce_sum(weights) * depth[p]
                seen_colour(sh, table, g, o, group, stamps, colours, basis)
                _add_light(sums, r, weight, colours[g])
                if sloped:
                    # ∫ t over a piece of a normal distribution: t* times its mass minus sigma times the drop of its density.
                    sums[r, 4] += t[p] * weight - sigma[p] * depth[p] * reduce_sum(drops) * _ROOT
                if sums.shape[1] > 5:
                    _add_normal(sums, r, weight, normals, g, d)
