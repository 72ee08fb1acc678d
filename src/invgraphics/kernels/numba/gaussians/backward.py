"""Gradients of the exact line integrals: of each ray's light in its Gaussians and in the ray itself."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.gaussians.integrals import STRIDE, colour_of, seen_colour, shares_origin
from invgraphics.kernels.numba.gaussians.pairs import restrict
from invgraphics.kernels.numba.gaussians.shares import FALLS, LIGHT, ROWS, SLOPES, WANTED, all_shares
from invgraphics.kernels.numba.harmonics import harmonics_gradient
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.lanes import broadcast, load, reduce_sum, store
from invgraphics.kernels.numba.simd.partial import unowned
from invgraphics.kernels.types import ALPHA_MAX

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LOG2E = np.float32(1 / np.log(2.0))
_LEAST_PASSED = np.float32((1 - ALPHA_MAX) * (1 + 1e-5))
_ROOT = np.float32(1 / np.sqrt(2 * np.pi))


@inlined
def cut_off(rgb, gradient):
    """Gradient through max(0, colour): where it is cut off, only what would raise it passes (see `core.harmonics.colour`)."""
    return gradient if rgb > _ZERO or gradient < _ZERO else _ZERO


@inlined
def _depths_gradient(lights):
    """Gradients in the optical depths of the intervals, given the summed ones in their light."""
    behind = _ZERO
    for k in range(lights.shape[1]):
        s = lights.shape[1] - 1 - k
        # A denser interval absorbs more itself and attenuates what is behind.
        lights[SLOPES, s] = lights[WANTED, s] * lights[FALLS, s] - behind
        behind += lights[WANTED, s] * lights[LIGHT, s]


@inlined
def _weights_gradients(gaussian, begin, end, depth, grad_sums, room, width, colours, weights, given):
    """Weights of a ray's Gaussians, gradients in them, and the sums of those in the light of the intervals."""
    rows, limits, _, lights = room
    for q in range(width // LANES):
        store(lights, WANTED * width + LANES * q, broadcast(_ZERO))
    for p in range(begin, end):
        i, g = p - begin, gaussian[p]
        if limits[i, 0] == limits[i, 1]:
            continue
        value = grad_sums[0]
        for c in range(3):
            value += grad_sums[1 + c] * max(colours[g, c], _ZERO)
        given[i] = value
        scaled, place, total = depth[p] * value, index(ROWS) * width * index(i), broadcast(_ZERO)
        for q in range(limits[i, 0], limits[i, 1]):
            own, wanted = load(rows, place + LANES * q), WANTED * width + LANES * q
            total += load(lights, LIGHT * width + LANES * q) * own
            store(lights, wanted, load(lights, wanted) + scaled * own)
        weights[i] = reduce_sum(total) * depth[p]


@inlined
def _shape_gradient(rows, place, width, lights, limits, given, inverse):
    """Gradients of one Gaussian's light in its optical depth, and times that depth in its distance and width.

    ``given`` is the gradient in its weight, ``inverse`` one over its width.
    """
    thicken, shift, widen = broadcast(_ZERO), broadcast(_ZERO), broadcast(_ZERO)
    for q in range(limits[0], limits[1]):
        at = LANES * q
        # Of the light in the Gaussian's share of each interval, per unit of its optical depth.
        slope = given * load(lights, LIGHT * width + at) + load(lights, SLOPES * width + at)
        thicken += slope * load(rows, place + at)
        shift += slope * load(rows, place + width + at)
        widen += slope * load(rows, place + width + width + at)
    scale = -_ROOT * inverse
    return reduce_sum(thicken), scale * reduce_sum(shift), scale * reduce_sum(widen)


@inlined
def _colour_gradient(sh, g, offset, inverse, basis, grad_rgb, grad_sh, buffer):
    """Add the gradient of a colour to that of its coefficients; returns the one in the offset."""
    for k in range(STRIDE):
        buffer[STRIDE * k] = _ZERO
    for k in range(sh.shape[1]):
        total = _ZERO
        for c in range(3):
            grad_sh[g, k, c] += basis[STRIDE * k] * grad_rgb[c]
            total += sh[g, k, c] * grad_rgb[c]
        buffer[STRIDE * k] = total
    ux, uy, uz = offset[0] * inverse, offset[1] * inverse, offset[2] * inverse
    gx, gy, gz = harmonics_gradient((ux, uy, uz), buffer, np.uintp(0))
    radial = gx * ux + gy * uy + gz * uz
    return (gx - radial * ux) * inverse, (gy - radial * uy) * inverse, (gz - radial * uz) * inverse


@inlined
def place_gradient(table, strength, reading, g, o, d, found, given, grad):
    """Add gradients in distance, width and depth to those of a Gaussian's row; returns those in offset and direction."""
    sigma, depth = found
    shift, widen, thicken = given
    if not reading[1]:
        # Of -ln(1 - alpha) in alpha, which is the optical depth before it was taken for an alpha; cut off at the largest one.
        passed = exp2(-depth * _LOG2E)
        depth, thicken = _ONE - passed, thicken / passed if passed > _LEAST_PASSED else _ZERO
    t, _, _, (x0, x1, x2), (d0, d1, d2) = restrict(table, g, o[0], o[1], o[2], d[0], d[1], d[2])
    grad[g, 12] += thicken * depth / strength[g]
    if reading[0]:
        widen += thicken * depth / sigma
    squared = -_HALF * thicken * depth
    y0, y1, y2 = x0 - t * d0, x1 - t * d1, x2 - t * d2
    rate = sigma * sigma
    a, b, c = _TWO * squared, shift * rate, -widen * rate * sigma
    # Of the whitened offset x and direction d: t = x.d / d.d, sigma = 1 / |d|, and |x - t d|².
    gx0, gx1, gx2 = a * y0 + b * d0, a * y1 + b * d1, a * y2 + b * d2
    gd0 = -a * t * y0 + b * (x0 - _TWO * t * d0) + c * d0
    gd1 = -a * t * y1 + b * (x1 - _TWO * t * d1) + c * d1
    gd2 = -a * t * y2 + b * (x2 - _TWO * t * d2) + c * d2
    cx, cy, cz = table[g, 0] - o[0], table[g, 1] - o[1], table[g, 2] - o[2]
    grad[g, 3] += gx0 * cx + gd0 * d[0]
    grad[g, 4] += gx0 * cy + gd0 * d[1]
    grad[g, 5] += gx0 * cz + gd0 * d[2]
    grad[g, 6] += gx1 * cx + gd1 * d[0]
    grad[g, 7] += gx1 * cy + gd1 * d[1]
    grad[g, 8] += gx1 * cz + gd1 * d[2]
    grad[g, 9] += gx2 * cx + gd2 * d[0]
    grad[g, 10] += gx2 * cy + gd2 * d[1]
    grad[g, 11] += gx2 * cz + gd2 * d[2]
    offset = (
        table[g, 3] * gx0 + table[g, 6] * gx1 + table[g, 9] * gx2,
        table[g, 4] * gx0 + table[g, 7] * gx1 + table[g, 10] * gx2,
        table[g, 5] * gx0 + table[g, 8] * gx1 + table[g, 11] * gx2,
    )
    direction = (
        table[g, 3] * gd0 + table[g, 6] * gd1 + table[g, 9] * gd2,
        table[g, 4] * gd0 + table[g, 7] * gd1 + table[g, 10] * gd2,
        table[g, 5] * gd0 + table[g, 8] * gd1 + table[g, 11] * gd2,
    )
    return offset, direction


@inlined
def spread_colour_gradients(sh, table, o, touched, count, work, basis, buffer, grad, grad_sh):
    """Pass the summed colour gradients of one origin on to coefficients and centres; returns the centres' sum."""
    sums, rgb = work[1], np.empty(3, np.float32)
    x, y, z = _ZERO, _ZERO, _ZERO
    for k in range(count):
        g = touched[k]
        offset = table[g, 0] - o[0], table[g, 1] - o[1], table[g, 2] - o[2]
        inverse = colour_of(sh, g, offset[0], offset[1], offset[2], basis, rgb)
        gx, gy, gz = _colour_gradient(sh, g, offset, inverse, basis, sums[g], grad_sh, buffer)
        sums[g] = _ZERO
        grad[g, 0] += gx
        grad[g, 1] += gy
        grad[g, 2] += gz
        x, y, z = x + gx, y + gy, z + gz
    return x, y, z


@parallel
def integrate_backward(rays, primitives, reading, pairs, first_ray, kept, grad_sums, rooms, grads):
    """Gradients of every job in the rows of Gaussians and in their coefficients, and in each ray's origin and direction.

    Those in colours are summed over rays of one origin that follow each other; ray by ray if origins have rows in ``grads``.
    """
    origins, directions = rays
    table, strength, sh = primitives
    gaussian, starts = pairs
    t, sigma, depth, nodes, stops = kept
    edges = index(nodes.shape[1])
    width = edges - index(1)
    for job in prange(len(first_ray) - 1):
        basis, buffer = np.empty(STRIDE * STRIDE, np.float32), np.empty(STRIDE * STRIDE, np.float32)
        rows, limits, lights = unowned(rooms[0][job]), rooms[1][job], unowned(rooms[2][job])
        room = rows, limits, rooms[2][job], lights
        weights, given = rooms[3][job, 0], rooms[3][job, 1]
        grad, grad_sh = grads[0][job], grads[1][job]
        stamps, touched, work = rooms[4][job, 0], rooms[4][job, 1], (rooms[5][job], rooms[6][job])
        colours, colour_sums = work
        group, count, by_ray = np.int32(0), 0, len(grads[2]) > 0
        for r in range(first_ray[job], first_ray[job + 1]):
            if by_ray or not shares_origin(origins, r, first_ray[job]):
                if count > 0:
                    spread_colour_gradients(sh, table, origins[r - 1], touched, count, work, basis, buffer, grad, grad_sh)
                group, count = group + np.int32(1), 0
            begin, end = starts[r], starts[r + 1]
            if begin == end:
                continue
            o, d = origins[r], directions[r]
            all_shares(unowned(nodes), index(r) * edges, stops[r], (t, sigma, depth), (begin, end), True, room)
            for p in range(begin, end):
                g = gaussian[p]
                if limits[p - begin, 0] < limits[p - begin, 1] and stamps[g] != group:
                    touched[count] = g
                    count += 1
                    seen_colour(sh, table, g, o, group, stamps, colours, basis)
            _weights_gradients(gaussian, begin, end, depth, grad_sums[r], room, width, colours, weights, given)
            _depths_gradient(rooms[2][job])
            for p in range(begin, end):
                i, g = p - begin, gaussian[p]
                if limits[i, 0] == limits[i, 1]:
                    continue
                place, reached = index(ROWS) * width * index(i), (limits[i, 0], limits[i, 1])
                thicken, shift, widen = _shape_gradient(rows, place, width, lights, reached, given[i], _ONE / sigma[p])
                found, moved = (sigma[p], depth[p]), (shift * depth[p], widen * depth[p], thicken)
                offset, direction = place_gradient(table, strength, reading, g, o, d, found, moved, grad)
                for c in range(3):
                    colour_sums[g, c] += cut_off(colours[g, c], weights[i] * grad_sums[r, 1 + c])
                    grad[g, c] += offset[c]
                    grads[3][r, c] += direction[c]
                    if by_ray:
                        grads[2][r, c] -= offset[c]
            if by_ray:
                seen = spread_colour_gradients(sh, table, o, touched, count, work, basis, buffer, grad, grad_sh)
                count = 0
                for c in range(3):
                    grads[2][r, c] -= seen[c]
        if count > 0:
            last = origins[first_ray[job + 1] - 1]
            spread_colour_gradients(sh, table, last, touched, count, work, basis, buffer, grad, grad_sh)
