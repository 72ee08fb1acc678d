"""Front-to-back compositing of footprints, backward.

The walk of the forward pass is repeated, front to back. What lies behind a footprint, which its alpha hides, is the pixel's
final sum minus what has been composited so far; so nothing but the picture itself needs to be kept per pixel.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, parallel, prange, share
from invgraphics.kernels.numba.simd.instructions import SOON, prefetch
from invgraphics.kernels.numba.simd.lanes import load, spread, store, total, totals, where
from invgraphics.kernels.numba.simd.layouts import read_colour_block, read_grey_block
from invgraphics.kernels.numba.splat.binning import FEATURES, HALF_LOG2E, OPACITY, POWER_XX, POWER_XY, POWER_YY
from invgraphics.kernels.numba.splat.raster import (
    BLOCK,
    BLOCKS,
    blended,
    corner,
    first_of,
    inside,
    pixels,
    placed,
    response_of,
    shape_of,
)
from invgraphics.kernels.types import ALPHA_MAX

# What a block holds for each of its pixels, LANES values each: transmittance, the loss's derivative along what is still to be
# composited, gradient of alpha, gradients of the picture's channels.
_T, _BEHIND, _ALPHA, _PICTURE = (index(slot) * LANES for slot in range(4))

# What is summed per footprint: v = dL/dalpha alpha times 1, x, y, x², x y, y²; then the gradients of its first three features,
# then the absolute ones where they are wanted. These fill a register; the gradients of further features follow it.
MOMENTS = 6
_ABSOLUTE = MOMENTS + 3
PULLS = 2
"""How many absolute gradients there are."""

# What few fits need must not slow down the others. A switch is a tuple whose length says whether it is on: Numba compiles the
# kernel anew for each length, and LLVM drops the code of what is off.
OFF, ON = 1, 2

_ALPHA_MAX = np.float32(ALPHA_MAX)
_ONE, _HALF, _ZERO = np.float32(1.0), np.float32(0.5), np.float32(0.0)
_TO_CONIC = _ONE / HALF_LOG2E


@inlined
def conic(rows, r):
    """The inverse covariance that the footprint came with."""
    return rows[r, POWER_XX] * _TO_CONIC, rows[r, POWER_XY] * (_HALF * _TO_CONIC), rows[r, POWER_YY] * _TO_CONIC


@inlined
def _open_tile(state, blocks, x0, y0, stride, image, alpha, image_gradient, alpha_gradient):
    """Load a tile's gradients, and the derivative along the whole of each pixel."""
    height, width, channels = image.shape
    while blocks:
        block, blocks = first_of(blocks)
        base = block * stride
        left, top = corner(x0, y0, block)
        state[base : base + stride] = _ZERO
        if channels == 3 and left + BLOCK <= width and top + BLOCK <= height:
            y, x, at = index(top), index(left), base + _PICTURE
            gradient, colour = read_colour_block(image_gradient, y, x), read_colour_block(image, y, x)
            (to_alpha,), (opacity,) = read_grey_block(alpha_gradient, y, x), read_grey_block(alpha, y, x)
            behind = to_alpha * opacity + gradient[0] * colour[0] + gradient[1] * colour[1] + gradient[2] * colour[2]
            store(state, base + _T, spread(_ONE))
            store(state, base + _BEHIND, behind)
            store(state, base + _ALPHA, to_alpha)
            store(state, at, gradient[0])
            store(state, at + LANES, gradient[1])
            store(state, at + LANES + LANES, gradient[2])
            continue
        # Pixels outside the image count as finished.
        store(state, base + _T, spread(-_ONE))
        for row in range(min(BLOCK, height - top)):
            for column in range(min(BLOCK, width - left)):
                y, x, at = index(top + row), index(left + column), base + index(row * BLOCK + column)
                behind = alpha_gradient[y, x] * alpha[y, x]
                for k in range(channels):
                    state[at + _PICTURE + index(k) * LANES] = image_gradient[y, x, index(k)]
                    behind += image_gradient[y, x, index(k)] * image[y, x, index(k)]
                state[at + _T], state[at + _BEHIND], state[at + _ALPHA] = _ONE, behind, alpha_gradient[y, x]


@inlined
def _receive(state, stride, rows, r, blocks, x0, y0, channels, sums, ends, past, absolute, grad_limit):
    """Repeat one footprint's blending onto blocks of a tile, and add what it receives from them to its row of ``sums``.

    Returns the blocks that it finished: those that end at ``past``.
    With ``grad_limit`` on, a block counts at its end the footprints that each of its pixels has seen.
    """
    shape, opacity = shape_of(rows, r)
    xx, xy, yy = conic(rows, r)
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
    (across, down), none = pixels(), spread(_ZERO)
    finished = index(0)
    sum_1 = sum_x = sum_y = sum_xx = sum_xy = sum_yy = sum_red = sum_green = sum_blue = pull_x = pull_y = none
    while blocks:
        block, blocks = first_of(blocks)
        left, top = placed(rows, r, x0, y0, block)
        dx, dy = across + left, down + top
        response, base = response_of(shape, opacity, dx, dy), block * stride
        alpha, transmittance, weight, goes_on = blended(state, base, response)
        at = base + _PICTURE
        to_red, to_green, to_blue = load(state, at), load(state, at + LANES), load(state, at + LANES + LANES)
        along = load(state, base + _ALPHA) + to_red * red + to_green * green + to_blue * blue
        for k in range(3, channels):
            along += load(state, at + index(k) * LANES) * rows[r, index(FEATURES + k)]
        behind = load(state, base + _BEHIND) - weight * along
        store(state, base + _BEHIND, behind)
        # alpha raises its own contribution and hides what is behind; where it is clamped or skipped it does not change.
        v = response * (transmittance * along - behind / (_ONE - alpha))
        v = where(goes_on & (response < _ALPHA_MAX), v, _ZERO)
        if len(grad_limit) == ON:
            rank = base + stride - LANES
            seen = load(state, rank) + where(alpha > _ZERO, _ONE, _ZERO)
            store(state, rank, seen)
            v, weight = where(seen <= grad_limit[0], v, _ZERO), where(seen <= grad_limit[0], weight, _ZERO)
        vx, vy = v * dx, v * dy
        sum_1, sum_x, sum_y = sum_1 + v, sum_x + vx, sum_y + vy
        sum_xx, sum_xy, sum_yy = sum_xx + vx * dx, sum_xy + vx * dy, sum_yy + vy * dy
        sum_red, sum_green, sum_blue = sum_red + weight * to_red, sum_green + weight * to_green, sum_blue + weight * to_blue
        if len(absolute) == ON:
            pull_x, pull_y = pull_x + abs(xx * vx + xy * vy), pull_y + abs(xy * vx + yy * vy)
        for k in range(3, channels):
            sums[r, LANES + index(k - 3)] += total(weight * load(state, at + index(k) * LANES))
        finished |= index(1) << block if ends[block] == past else index(0)
    found = totals((sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy, sum_red, sum_green, sum_blue, pull_x, pull_y))
    own = r * index(sums.shape[1])
    store(sums, own, load(sums, own) + found)
    return finished


@inlined
def _walk_tile(rows, entries, first, last, x0, y0, channels, state, stride, alive, touched, ends, sums, absolute, grad_limit):
    """Walk a tile's footprints front to back and add what each of them receives to ``sums``."""
    for entry in range(first, last):
        if not alive:
            break
        ahead = index(entries[index(min(entry + SOON, last - 1))])
        prefetch(rows, ahead)
        prefetch(sums, ahead)
        r, blocks = index(entries[index(entry)]), touched[index(entry)] & alive
        if blocks:
            alive ^= _receive(state, stride, rows, r, blocks, x0, y0, channels, sums, ends, entry + 1, absolute, grad_limit)


@parallel
def walk_back(
    rows, entries, starts, bounds, edge, columns, touched, ends, image, alpha, image_gradient, alpha_gradient, sums, absolute,
    grad_limit,
):  # fmt: skip
    """Per job and packed footprint, the sums from which `gather` makes gradients (other arguments as in `rasterise`).

    Two switches: ``absolute`` adds `PULLS` sums of absolute gradients; ``grad_limit`` lets only so many footprints of a pixel,
    from the front, receive its gradient.
    """
    height, width = alpha.shape
    channels = rows.shape[1] - FEATURES
    stride = _PICTURE + LANES * index(channels + (1 if len(grad_limit) == ON else 0))
    for job in prange(len(bounds) - 1):
        state = np.empty(BLOCKS * stride, np.float32)
        own = sums[job]
        own[:] = _ZERO
        for tile in range(bounds[job], bounds[job + 1]):
            if starts[tile] < starts[tile + 1]:
                x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
                blocks = inside(x0, y0, edge, width, height)
                _open_tile(state, blocks, x0, y0, stride, image, alpha, image_gradient, alpha_gradient)
                _walk_tile(
                    rows, entries, starts[tile], starts[tile + 1], x0, y0, channels, state, stride,
                    blocks, touched, ends[tile], own, absolute, grad_limit,
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
                features[i, k] = s[MOMENTS + k] if k < 3 else s[LANES + index(k - 3)]
            if len(pulls):
                pulls[i, 0], pulls[i, 1] = s[_ABSOLUTE], s[_ABSOLUTE + 1]
