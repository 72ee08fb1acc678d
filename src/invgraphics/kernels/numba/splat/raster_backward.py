"""Rasterise to pixels, backward: gradients of means2d, conics, opacities and features.

The forward pass is repeated, front to back. The contribution behind a footprint is the pixel's final value minus what has been
composited so far; so nothing but the image itself is stored per pixel. Judged by `invgraphics.kernels.reference`.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, job_start, parallel, prange
from invgraphics.kernels.numba.simd.instructions import PREFETCH_DISTANCE, prefetch
from invgraphics.kernels.numba.simd.lanes import broadcast, load, reduce_sum, reduce_sums, store, where
from invgraphics.kernels.numba.simd.layouts import read_colour_block, read_grey_block
from invgraphics.kernels.numba.splat.binning import FEATURES, HALF_LOG2E, OPACITY, POWER_XX, POWER_XY, POWER_YY
from invgraphics.kernels.numba.splat.raster import (
    BLOCK,
    BLOCKS,
    blend,
    block_offset,
    block_origin,
    exponent_of,
    gaussian_response,
    image_blocks,
    pixel_offsets,
    pop_block,
)
from invgraphics.kernels.types import ALPHA_MAX

# State of a block, LANES values each: transmittance, loss derivative along what is still to be composited, gradient of alpha,
# gradients of the image's channels.
_T, _BEHIND, _ALPHA, _IMAGE = (index(slot) * LANES for slot in range(4))

# Sums per footprint: v = dL/dalpha alpha times 1, x, y, x², x y, y²; gradients of its first three features; absolute gradients
# if wanted. These fill a register; gradients of further features follow it.
MOMENTS = 6
_ABSOLUTE = MOMENTS + 3
ABSGRADS = 2
"""Number of absolute gradients, d/dx and d/dy."""

# Compile-time switches: a tuple whose length says on or off. Numba specialises the kernel for each length, and LLVM drops the
# code of what is off.
OFF, ON = 1, 2

_ALPHA_MAX = np.float32(ALPHA_MAX)
_ONE, _HALF, _ZERO = np.float32(1.0), np.float32(0.5), np.float32(0.0)
_TO_CONIC = _ONE / HALF_LOG2E


@inlined
def conic(rows, r):
    """Inverse covariance of a packed footprint."""
    return rows[r, POWER_XX] * _TO_CONIC, rows[r, POWER_XY] * (_HALF * _TO_CONIC), rows[r, POWER_YY] * _TO_CONIC


@inlined
def _init_tile(state, blocks, x0, y0, stride, image, alpha, grad_image, grad_alphas):
    """Load a tile's image gradients, and each pixel's derivative along all that is to be composited."""
    height, width, channels = image.shape
    while blocks:
        block, blocks = pop_block(blocks)
        base = block * stride
        left, top = block_origin(x0, y0, block)
        state[base : base + stride] = _ZERO
        if channels == 3 and left + BLOCK <= width and top + BLOCK <= height:
            y, x, at = index(top), index(left), base + _IMAGE
            gradient, colour = read_colour_block(grad_image, y, x), read_colour_block(image, y, x)
            (grad_alpha,), (opacity,) = read_grey_block(grad_alphas, y, x), read_grey_block(alpha, y, x)
            behind = grad_alpha * opacity + gradient[0] * colour[0] + gradient[1] * colour[1] + gradient[2] * colour[2]
            store(state, base + _T, broadcast(_ONE))
            store(state, base + _BEHIND, behind)
            store(state, base + _ALPHA, grad_alpha)
            store(state, at, gradient[0])
            store(state, at + LANES, gradient[1])
            store(state, at + LANES + LANES, gradient[2])
            continue
        # Pixels outside the image count as finished.
        store(state, base + _T, broadcast(-_ONE))
        for row in range(min(BLOCK, height - top)):
            for column in range(min(BLOCK, width - left)):
                y, x, at = index(top + row), index(left + column), base + index(row * BLOCK + column)
                behind = grad_alphas[y, x] * alpha[y, x]
                for k in range(channels):
                    state[at + _IMAGE + index(k) * LANES] = grad_image[y, x, index(k)]
                    behind += grad_image[y, x, index(k)] * image[y, x, index(k)]
                state[at + _T], state[at + _BEHIND], state[at + _ALPHA] = _ONE, behind, grad_alphas[y, x]


@inlined
def _blend_splat_backward(state, stride, rows, r, blocks, x0, y0, channels, sums, last_entries, past, absolute, grad_limit):
    """Repeat one footprint's blending onto blocks of a tile, and accumulate its gradients in its row of ``sums``.

    Returns the mask of blocks that it finished: those whose last entry is ``past``. With ``grad_limit`` on, the end of a
    block's state counts the footprints composited to each pixel so far.
    """
    exponent, opacity = exponent_of(rows, r)
    xx, xy, yy = conic(rows, r)
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
    (across, down), zero = pixel_offsets(), broadcast(_ZERO)
    finished = index(0)
    sum_1 = sum_x = sum_y = sum_xx = sum_xy = sum_yy = sum_red = sum_green = sum_blue = abs_x = abs_y = zero
    while blocks:
        block, blocks = pop_block(blocks)
        left, top = block_offset(rows, r, x0, y0, block)
        dx, dy = across + left, down + top
        response, base = gaussian_response(exponent, opacity, dx, dy), block * stride
        alpha, transmittance, weight, active = blend(state, base, response)
        at = base + _IMAGE
        grad_red, grad_green, grad_blue = load(state, at), load(state, at + LANES), load(state, at + LANES + LANES)
        along = load(state, base + _ALPHA) + grad_red * red + grad_green * green + grad_blue * blue
        for k in range(3, channels):
            along += load(state, at + index(k) * LANES) * rows[r, index(FEATURES + k)]
        behind = load(state, base + _BEHIND) - weight * along
        store(state, base + _BEHIND, behind)
        # alpha raises its own contribution and hides what is behind; where it is clamped or skipped it does not change.
        v = response * (transmittance * along - behind / (_ONE - alpha))
        v = where(active & (response < _ALPHA_MAX), v, _ZERO)
        if len(grad_limit) == ON:
            rank = base + stride - LANES
            seen = load(state, rank) + where(alpha > _ZERO, _ONE, _ZERO)
            store(state, rank, seen)
            v, weight = where(seen <= grad_limit[0], v, _ZERO), where(seen <= grad_limit[0], weight, _ZERO)
        vx, vy = v * dx, v * dy
        sum_1, sum_x, sum_y = sum_1 + v, sum_x + vx, sum_y + vy
        sum_xx, sum_xy, sum_yy = sum_xx + vx * dx, sum_xy + vx * dy, sum_yy + vy * dy
        sum_red, sum_green, sum_blue = (
            sum_red + weight * grad_red,
            sum_green + weight * grad_green,
            sum_blue + weight * grad_blue,
        )
        if len(absolute) == ON:
            abs_x, abs_y = abs_x + abs(xx * vx + xy * vy), abs_y + abs(xy * vx + yy * vy)
        for k in range(3, channels):
            sums[r, LANES + index(k - 3)] += reduce_sum(weight * load(state, at + index(k) * LANES))
        finished |= index(1) << block if last_entries[block] == past else index(0)
    found = reduce_sums((sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy, sum_red, sum_green, sum_blue, abs_x, abs_y))
    own = r * index(sums.shape[1])
    store(sums, own, load(sums, own) + found)
    return finished


@inlined
def _backward_tile(
    rows,
    entries,
    first,
    last,
    x0,
    y0,
    channels,
    state,
    stride,
    active_blocks,
    touched,
    last_entries,
    sums,
    absolute,
    grad_limit,
):
    """Accumulate the gradients of a tile's footprints, front to back, in ``sums``."""
    for entry in range(first, last):
        if not active_blocks:
            break
        ahead = index(entries[index(min(entry + PREFETCH_DISTANCE, last - 1))])
        prefetch(rows, ahead)
        prefetch(sums, ahead)
        r, blocks = index(entries[index(entry)]), touched[index(entry)] & active_blocks
        if blocks:
            active_blocks ^= _blend_splat_backward(
                state, stride, rows, r, blocks, x0, y0, channels, sums, last_entries, entry + 1, absolute, grad_limit
            )


@parallel
def rasterise_backward(
    rows, entries, starts, bounds, edge, columns, touched, last_entries, image, alpha, grad_image, grad_alphas, sums, absolute,
    grad_limit,
):  # fmt: skip
    """Gradient sums per job and packed footprint, for `reduce_gradients`; other arguments as in `rasterise`.

    Two switches: ``absolute`` adds `ABSGRADS` sums of absolute gradients; ``grad_limit`` restricts gradients to the first so
    many footprints of each pixel.
    """
    height, width = alpha.shape
    channels = rows.shape[1] - FEATURES
    stride = _IMAGE + LANES * index(channels + (1 if len(grad_limit) == ON else 0))
    for job in prange(len(bounds) - 1):
        state = np.empty(BLOCKS * stride, np.float32)
        own = sums[job]
        own[:] = _ZERO
        for tile in range(bounds[job], bounds[job + 1]):
            if starts[tile] < starts[tile + 1]:
                x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
                blocks = image_blocks(x0, y0, edge, width, height)
                _init_tile(state, blocks, x0, y0, stride, image, alpha, grad_image, grad_alphas)
                _backward_tile(
                    rows, entries, starts[tile], starts[tile + 1], x0, y0, channels, state, stride,
                    blocks, touched, last_entries[tile], own, absolute, grad_limit,
                )  # fmt: skip


@parallel
def reduce_gradients(order, rows, sums, means, conics, opacities, features, absgrads):
    """Reduce the jobs' sums in a fixed order and write gradients to the caller's arrays (zeros for culled footprints).

    ``absgrads`` has no rows where absolute gradients are not wanted.
    """
    jobs, m = sums.shape[0], len(order)
    for job in prange(jobs):
        for r in range(job_start(m, jobs, job), job_start(m, jobs, job + 1)):
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
            if len(absgrads):
                absgrads[i, 0], absgrads[i, 1] = s[_ABSOLUTE], s[_ABSOLUTE + 1]
