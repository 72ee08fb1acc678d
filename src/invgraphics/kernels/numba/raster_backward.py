"""Front-to-back compositing of footprints, backward.

The walk of the forward pass is repeated, front to back. What lies behind a footprint, which its alpha hides, is the pixel's
final sum minus what has been composited so far; so nothing but the picture itself needs to be kept per pixel.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.binning import FEATURES, HALF_LOG2E, OPACITY, POWER_XX, POWER_XY, POWER_YY
from invgraphics.kernels.numba.instructions import SOON, lowest_bit, prefetch
from invgraphics.kernels.numba.raster import BLOCK, BLOCKS, EDGE, inside, placed
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, parallel, prange, share
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

# What a block holds for each of its pixels, LANES values each: transmittance, the loss's derivative along what is still to be
# composited, gradient of alpha, gradient along the current footprint's features beyond the first three, gradients of the
# picture's channels.
_T, _BEHIND, _ALPHA, _ALONG, _PICTURE = (index(slot) * LANES for slot in range(5))

# What is summed per footprint, before the features: v = dL/dalpha alpha times 1, x, y, x², x y, y².
MOMENTS = 6
FIRST_SUMS = MOMENTS + 3
"""Sums that are kept lane by lane while a footprint is on a tile: adding lanes up once is cheaper than for every block."""
HALF = LANES // index(2)
"""Lanes of those sums: the pixels of half a block."""
_DOWN = np.float32(BLOCK // 2)
"""Pixels from the upper half of a block to the lower."""
PULLS = 2
"""Further sums, behind those of the features, where absolute gradients are wanted."""
_V, _WEIGHT, _ROOM = (index(FIRST_SUMS + PULLS) * HALF + index(slot) * LANES for slot in range(3))
"""Behind those lanes: v and weight that the current footprint has in each pixel of the current block."""

# What few fits need must not slow down the others. A switch is a tuple whose length says whether it is on: Numba compiles the
# kernel anew for each length, and LLVM drops the code of what is off.
OFF, ON = 1, 2

_ALPHA_MIN, _ALPHA_MAX = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX)
_STOP = np.float32(TRANSMITTANCE_MIN)
_ONE, _HALF, _ZERO = np.float32(1.0), np.float32(0.5), np.float32(0.0)
_TO_CONIC = _ONE / HALF_LOG2E


@inlined
def conic(rows, r):
    """The inverse covariance that the footprint came with."""
    return rows[r, POWER_XX] * _TO_CONIC, rows[r, POWER_XY] * (_HALF * _TO_CONIC), rows[r, POWER_YY] * _TO_CONIC


@inlined
def _hand_over(state, at, image, gradient, y, x, k):
    """Copy a channel's gradient to its pixel's place; returns the loss's derivative along the whole channel."""
    state[at + _PICTURE + k * LANES] = gradient[y, x, k]
    return gradient[y, x, k] * image[y, x, k]


@inlined
def _open_tile(state, x0, y0, edge, stride, image, alpha, image_gradient, alpha_gradient):
    """Load a tile's gradients, and the derivative along the whole of each pixel."""
    height, width, channels = image.shape
    state[:] = _ZERO
    for j in range(edge):
        for i in range(edge):
            left, top = x0 + i * BLOCK, y0 + j * BLOCK
            base = index(j * EDGE + i) * stride
            # Pixels outside the image count as finished.
            state[base : base + LANES] = -_ONE
            for row in range(min(BLOCK, height - top)):
                for column in range(min(BLOCK, width - left)):
                    y, x, at = index(top + row), index(left + column), base + index(row * BLOCK + column)
                    gradient = alpha_gradient[y, x]
                    behind = gradient * alpha[y, x]
                    if channels == 3:
                        behind += _hand_over(state, at, image, image_gradient, y, x, index(0))
                        behind += _hand_over(state, at, image, image_gradient, y, x, index(1))
                        behind += _hand_over(state, at, image, image_gradient, y, x, index(2))
                    else:
                        for k in range(channels):
                            behind += _hand_over(state, at, image, image_gradient, y, x, index(k))
                    state[at + _T], state[at + _BEHIND] = _ONE, behind
                    state[at + _ALPHA], state[at + _ALONG] = gradient, gradient


@inlined
def _unblend(state, lanes, base, rows, r, dx0, dy0, rank, receivers):
    """Repeat one footprint's blending onto one block: what it has there is left behind the lanes.

    With ``receivers`` on, ``rank`` is where the block counts the footprints that each of its pixels has seen.
    """
    xx, xy, yy = rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]
    opacity = rows[r, OPACITY]
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
    for lane in range(LANES):
        dx = dx0 + np.float32(lane & index(3))
        dy = dy0 + np.float32(lane >> index(2))
        response = opacity * exp2(xx * dx * dx + xy * dx * dy + yy * dy * dy)
        response = response if response >= _ALPHA_MIN else _ZERO
        alpha = min(response, _ALPHA_MAX)
        transmittance = state[base + lane]
        weight = transmittance * alpha
        after = transmittance - weight
        goes_on = after >= _STOP
        weight = weight if goes_on else _ZERO
        g_red = state[base + _PICTURE + lane]
        g_green = state[base + _PICTURE + LANES + lane]
        g_blue = state[base + _PICTURE + LANES + LANES + lane]
        along = state[base + _ALONG + lane] + g_red * red + g_green * green + g_blue * blue
        behind = state[base + _BEHIND + lane] - weight * along
        state[base + _BEHIND + lane] = behind
        state[base + lane] = after if goes_on else -abs(transmittance)
        # alpha raises its own contribution and hides what is behind; where it is clamped or skipped it does not change.
        v = response * (transmittance * along - behind / (_ONE - alpha))
        v = v if goes_on else _ZERO
        v = v if response < _ALPHA_MAX else _ZERO
        if len(receivers) == ON:
            seen = state[rank + lane] + (_ONE if alpha > _ZERO else _ZERO)
            state[rank + lane] = seen
            v = v if seen <= receivers[0] else _ZERO
            weight = weight if seen <= receivers[0] else _ZERO
        lanes[_WEIGHT + lane] = weight
        lanes[_V + lane] = v


@inlined
def _sum(state, lanes, half, base, rows, r, dx0, dy0, absolute):
    """Add what the footprint has on the block to its sums, lane by lane, the upper half and the lower to the same ones.

    ``half`` is `HALF` where the compiler cannot see it: it would unroll the loop, and then find no vectors in it.
    """
    for lane in range(half):
        dx = dx0 + np.float32(lane & index(3))
        dy = dy0 + np.float32(lane >> index(2))
        below = dy + _DOWN
        v, w = lanes[_V + lane], lanes[_V + HALF + lane]
        both, vy, wy = v + w, v * dy, w * below
        y = vy + wy
        lanes[lane] += both
        lanes[HALF + lane] += both * dx
        lanes[index(2) * HALF + lane] += y
        lanes[index(3) * HALF + lane] += both * dx * dx
        lanes[index(4) * HALF + lane] += y * dx
        lanes[index(5) * HALF + lane] += vy * dy + wy * below
        first, second = lanes[_WEIGHT + lane], lanes[_WEIGHT + HALF + lane]
        at = base + _PICTURE + lane
        lanes[index(6) * HALF + lane] += first * state[at] + second * state[at + HALF]
        lanes[index(7) * HALF + lane] += first * state[at + LANES] + second * state[at + LANES + HALF]
        at += index(2) * LANES
        lanes[index(8) * HALF + lane] += first * state[at] + second * state[at + HALF]
        if len(absolute) == ON:
            xx, xy, yy = conic(rows, r)
            vx, wx = v * dx, w * dx
            lanes[index(9) * HALF + lane] += abs(xx * vx + xy * vy) + abs(xx * wx + xy * wy)
            lanes[index(10) * HALF + lane] += abs(xy * vx + yy * vy) + abs(xy * wx + yy * wy)


@inlined
def _look_along(state, base, rows, r, triples):
    """Gradient of alpha plus the dot product of the picture's gradients and the features beyond the first three."""
    for lane in range(LANES):
        state[base + _ALONG + lane] = state[base + _ALPHA + lane]
    for k in range(3, 3 * triples):
        value = rows[r, index(FEATURES + k)]
        channel = _PICTURE + index(k) * LANES
        for lane in range(LANES):
            state[base + _ALONG + lane] += state[base + channel + lane] * value


@inlined
def _sum_further(state, lanes, base, sums, r, triples):
    """Gradients of the features beyond the first three."""
    for k in range(3, 3 * triples):
        channel = _PICTURE + index(k) * LANES
        total = _ZERO
        for lane in range(LANES):
            total += lanes[_WEIGHT + lane] * state[base + channel + lane]
        sums[r, index(MOMENTS + k)] += total


@inlined
def _add_up(lanes, half, sums, r, absolute):
    """Move a footprint's sums from the lanes, which are cleared, to its row."""
    for k in range(FIRST_SUMS + (PULLS if len(absolute) == ON else 0)):
        total = _ZERO
        for lane in range(half):
            total += lanes[index(k) * HALF + lane]
            lanes[index(k) * HALF + lane] = _ZERO
        to = k if k < FIRST_SUMS else sums.shape[1] - PULLS + k - FIRST_SUMS
        sums[r, index(to)] += total


@inlined
def _walk_tile(
    rows, entries, first, last, x0, y0, triples, state, lanes, stride, alive, touched, ends, sums, absolute, receivers
):  # fmt: skip
    """Walk a tile's footprints front to back and add what each of them receives to ``sums``."""
    half = index(len(lanes) // (_ROOM // HALF))
    for entry in range(first, last):
        if not alive:
            break
        ahead = index(entries[index(min(entry + SOON, last - 1))])
        prefetch(rows, ahead)
        prefetch(sums, ahead)
        r, blocks = index(entries[index(entry)]), touched[index(entry)] & alive
        if blocks:
            while blocks:
                block = lowest_bit(blocks)
                base = block * stride
                dx, dy = placed(rows, r, x0, y0, block)
                if triples > 1:
                    _look_along(state, base, rows, r, triples)
                _unblend(state, lanes, base, rows, r, dx, dy, base + stride - LANES, receivers)
                _sum(state, lanes, half, base, rows, r, dx, dy, absolute)
                if triples > 1:
                    _sum_further(state, lanes, base, sums, r, triples)
                if entry + 1 == ends[block]:
                    alive ^= index(1) << block
                blocks &= blocks - index(1)
            _add_up(lanes, half, sums, r, absolute)


@parallel
def walk_back(
    rows, entries, starts, bounds, edge, columns, touched, ends, image, alpha, image_gradient, alpha_gradient, sums, absolute,
    receivers,
):  # fmt: skip
    """Per job and packed footprint, the sums from which `gather` makes gradients (arguments as in `rasterise`).

    Two switches: ``absolute`` adds `PULLS` sums of absolute gradients; ``receivers`` lets only so many footprints of a pixel,
    from the front, receive its gradient.
    """
    height, width = alpha.shape
    triples = (rows.shape[1] - FEATURES) // 3
    stride = _PICTURE + LANES * index(3 * triples + (1 if len(receivers) == ON else 0))
    for job in prange(len(bounds) - 1):
        state, lanes = np.empty(BLOCKS * stride, np.float32), np.zeros(_ROOM, np.float32)
        own = sums[job]
        own[:] = _ZERO
        for tile in range(bounds[job], bounds[job + 1]):
            if starts[tile] < starts[tile + 1]:
                x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
                _open_tile(state, x0, y0, edge, stride, image, alpha, image_gradient, alpha_gradient)
                _walk_tile(
                    rows, entries, starts[tile], starts[tile + 1], x0, y0, triples, state, lanes, stride,
                    inside(x0, y0, edge, width, height), touched, ends[tile], own, absolute, receivers,
                )  # fmt: skip


@parallel
def gather(order, rows, sums, means, conics, opacities, features, pulls):
    """Add up the jobs in a fixed order and write gradients to the caller's arrays, which hold zeros for culled footprints.

    ``pulls`` has no rows where absolute gradients are not wanted.
    """
    jobs, m = sums.shape[0], len(order)
    for job in prange(jobs):
        for r in range(share(m, jobs, job), share(m, jobs, job + 1)):
            i = index(order[r])
            for other in range(1, jobs):
                for k in range(sums.shape[2]):
                    sums[0, r, k] += sums[other, r, k]
            s = sums[0, r]
            xx, xy, yy = conic(rows, r)
            # response = opacity exp(-q / 2), q = xx dx² + 2 xy dx dy + yy dy², (dx, dy) = pixel - mean.
            means[i, 0], means[i, 1] = xx * s[1] + xy * s[2], xy * s[1] + yy * s[2]
            conics[i, 0], conics[i, 1], conics[i, 2] = -_HALF * s[3], -s[4], -_HALF * s[5]
            opacities[i] = s[0] / rows[r, OPACITY] if s[0] != _ZERO else _ZERO
            for k in range(features.shape[1]):
                features[i, k] = s[MOMENTS + k]
            if len(pulls):
                pulls[i, 0], pulls[i, 1] = s[len(s) - 2], s[len(s) - 1]
