"""Rasterise to pixels, forward: front-to-back alpha compositing of each tile's footprints.

A tile is processed in blocks of 4 x 4 pixels, one pixel per SIMD lane. Its state lies in one flat scratch array, block after
block, so that it stays in the L1 cache. A set of blocks is a 64-bit mask. Judged by `invgraphics.kernels.reference`.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.instructions import count_bits, lowest_bit, prefetch
from invgraphics.kernels.numba.simd.lanes import any_of, bits_below, exp2_of, lane_index, load, store, where
from invgraphics.kernels.numba.simd.layouts import write_colour_block, write_grey_block
from invgraphics.kernels.numba.splat.binning import (
    ASPECT,
    FEATURES,
    HALF_HEIGHT,
    MARGIN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    POWER_XX,
    POWER_XY,
    POWER_YY,
    RIGHTMOST_Y,
    SHEAR,
    half_span,
)
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

BLOCK = 4
"""Edge of a block in pixels, which are the `LANES`."""
EDGE = 8
"""Maximum number of blocks along a tile's edge: the mask has 64 bits, and the state must fit into the L1 cache."""
BLOCKS = index(EDGE * EDGE)
BATCH = 16
"""Footprints that are intersected with blocks before the first of them is composited."""

_ALPHA_MIN, _ALPHA_MAX = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX)
_TRANSMITTANCE_MIN = np.float32(TRANSMITTANCE_MIN)
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@inlined
def overlapped_blocks(rows, entries, begin, end, x0, y0, blocks, touched):
    """Intersect a batch of footprints with a tile's ``blocks``; their masks are written to ``touched``.

    In batches, ahead of compositing: loops over the blocks of each row would mispredict while they wait for square roots. Half
    of the lanes count the blocks of each row that begin before the ellipse's right end; the others, turned by 180 degrees,
    those that end before its left end.
    """
    numbers, height, half = lane_index(), np.float32(BLOCK - 1), np.float32(0.5)
    turned = numbers >= np.float32(EDGE)
    side = where(turned, -_ONE, _ONE)
    row = where(turned, numbers - np.float32(EDGE), numbers) * np.float32(BLOCK) + half
    top = where(turned, -row - height, row)
    for entry in range(begin, end):
        prefetch(rows, index(entries[index(min(entry + BATCH, len(entries) - 1))]))
        r = index(entries[index(entry)])
        x, y, half_height = rows[r, MEAN_X] - x0, rows[r, MEAN_Y] - y0, rows[r, HALF_HEIGHT]
        ellipse = rows[r, RIGHTMOST_Y], half_height, rows[r, SHEAR], rows[r, ASPECT]
        low = top - side * y
        high = low + height
        width, middle = half_span(ellipse, min(max(low, ellipse[0]), high))
        reached = np.floor((middle + width + side * x + (height + half + MARGIN)) * np.float32(1.0 / BLOCK))
        counts = min(max(side * reached, _ZERO), np.float32(EDGE))
        begun, passed = bits_below(where((low <= half_height) & (high >= -half_height), counts, _ZERO))
        touched[index(entry)] = begun & ~passed & blocks


@inlined
def pop_block(blocks):
    """Lowest block of a mask, and the mask without it."""
    return lowest_bit(blocks), blocks & (blocks - index(1))


@inlined
def block_origin(x0, y0, block):
    """First pixel of a block of the tile at (x0, y0)."""
    return x0 + np.int64(block % index(EDGE)) * BLOCK, y0 + np.int64(block // index(EDGE)) * BLOCK


@inlined
def block_offset(rows, r, x0, y0, block):
    """Offset of a block's first pixel centre from a footprint's mean."""
    left, top = block_origin(x0, y0, block)
    half = np.float32(0.5)
    return np.float32(left) + half - rows[r, MEAN_X], np.float32(top) + half - rows[r, MEAN_Y]


@inlined
def pixel_offsets():
    """Offsets in x and y of each of a block's pixels from its first."""
    numbers = lane_index()
    down = np.floor(numbers / np.float32(BLOCK))
    return numbers - down * np.float32(BLOCK), down


@inlined
def image_blocks(x0, y0, edge, width, height):
    """Mask of a tile's blocks that overlap the image."""
    blocks = index(0)
    for j in range(min(edge, -(-(height - y0) // BLOCK))):
        for i in range(min(edge, -(-(width - x0) // BLOCK))):
            blocks |= index(1) << index(j * EDGE + i)
    return blocks


@inlined
def _init_tile(state, blocks, x0, y0, width, height, stride):
    """Initialise transmittance: 1 on pixels of the image, -1 (finished) outside."""
    across, down = pixel_offsets()
    while blocks:
        block, blocks = pop_block(blocks)
        base = block * stride
        state[base : base + stride] = _ZERO
        left, top = block_origin(x0, y0, block)
        in_image = (across < np.float32(width - left)) & (down < np.float32(height - top))
        store(state, base, where(in_image, _ONE, -_ONE))


@inlined
def gaussian_response(exponent, opacity, dx, dy):
    """Response of a footprint, opacity exp(-q / 2), at offsets ``dx``, ``dy`` from its mean; 0 below 1/255."""
    xx, xy, yy = exponent
    response = opacity * exp2_of((xx * dx + xy * dy) * dx + yy * dy * dy)
    return where(response >= _ALPHA_MIN, response, _ZERO)


@inlined
def exponent_of(rows, r):
    """Coefficients of a footprint's quadratic exponent, and its opacity."""
    return (rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]), rows[r, OPACITY]


@inlined
def blend(state, base, response):
    """Alpha-blend a footprint onto a block, updating its transmittance in ``state``.

    Returns alpha, the transmittance before, the weight, and the mask of pixels that remain active.
    """
    alpha = min(response, _ALPHA_MAX)
    transmittance = load(state, base)
    weight = transmittance * alpha
    after = transmittance - weight
    # Finished pixels carry their final transmittance with a minus sign, so they stay below the limit.
    active = after >= _TRANSMITTANCE_MIN
    store(state, base, where(active, after, -abs(transmittance)))
    return alpha, transmittance, where(active, weight, _ZERO), active


@inlined
def _blend_splat(state, stride, rows, r, blocks, x0, y0, channels):
    """Composite one footprint onto blocks of a tile; returns the mask of blocks that it finished."""
    exponent, opacity = exponent_of(rows, r)
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
    across, down = pixel_offsets()
    finished = index(0)
    while blocks:
        block, blocks = pop_block(blocks)
        left, top = block_offset(rows, r, x0, y0, block)
        base = block * stride
        _, _, weight, active = blend(state, base, gaussian_response(exponent, opacity, across + left, down + top))
        at = base + LANES
        store(state, at, load(state, at) + weight * red)
        store(state, at + LANES, load(state, at + LANES) + weight * green)
        store(state, at + LANES + LANES, load(state, at + LANES + LANES) + weight * blue)
        for k in range(3, channels):
            at = base + index(1 + k) * LANES
            store(state, at, load(state, at) + weight * rows[r, index(FEATURES + k)])
        finished |= index(0) if any_of(active) else index(1) << block
    return finished


@inlined
def _composite_tile(rows, entries, first, last, x0, y0, channels, state, active_blocks, touched, last_entries):
    """Composite a tile's footprints front to back until all pixels are finished; returns the number of block visits."""
    stride = LANES * index(1 + channels)
    visited = 0
    for begin in range(first, last, BATCH):
        end = min(begin + BATCH, last)
        overlapped_blocks(rows, entries, begin, end, np.float32(x0), np.float32(y0), active_blocks, touched)
        for entry in range(begin, end):
            blocks = touched[index(entry)] & active_blocks
            visited += count_bits(blocks)
            finished = _blend_splat(state, stride, rows, index(entries[index(entry)]), blocks, x0, y0, channels)
            active_blocks ^= finished
            while finished:
                block, finished = pop_block(finished)
                last_entries[block] = entry + 1
        if active_blocks == 0:
            break
    return visited


@inlined
def _write_tile(state, blocks, x0, y0, stride, image, alpha):
    """Write a tile's sums to the image."""
    height, width, channels = image.shape
    while blocks:
        block, blocks = pop_block(blocks)
        base = block * stride
        left, top = block_origin(x0, y0, block)
        if channels == 3 and left + BLOCK <= width and top + BLOCK <= height:
            write_grey_block(alpha, index(top), index(left), (_ONE - abs(load(state, base)),))
            at = base + LANES
            colour = load(state, at), load(state, at + LANES), load(state, at + LANES + LANES)
            write_colour_block(image, index(top), index(left), colour)
        else:
            for row in range(min(BLOCK, height - top)):
                for column in range(min(BLOCK, width - left)):
                    y, x, at = index(top + row), index(left + column), base + index(row * BLOCK + column)
                    alpha[y, x] = _ONE - abs(state[at])
                    for k in range(channels):
                        image[y, x, index(k)] = state[at + index(1 + k) * LANES]


@parallel
def rasterise(rows, entries, starts, bounds, edge, columns, image, alpha, touched, last_entries, work):
    """Composite every tile.

    Args:
        rows: packed footprints, front to back.
        entries: positions in ``rows``, tile after tile.
        starts: first entry of each tile.
        bounds: first tile of each job, and the number of tiles at the end.
        edge: blocks along a tile's edge.
        columns: tiles per row.
        image: output, sums of w * features (h, w, c).
        alpha: output, sums of w (h, w).
        touched: output, per entry the mask of blocks that it touches; undefined behind a tile's last composited entry.
        last_entries: output, per tile and block, one past the entry at which its last pixel was finished.
        work: output, block visits per tile.
    """
    height, width = alpha.shape
    # Features were filled up to a multiple of three.
    channels = rows.shape[1] - FEATURES
    stride = LANES * index(1 + channels)
    for job in prange(len(bounds) - 1):
        state = np.empty(BLOCKS * stride, np.float32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            blocks = image_blocks(x0, y0, edge, width, height)
            _init_tile(state, blocks, x0, y0, width, height, stride)
            first, last = starts[tile], starts[tile + 1]
            last_entries[tile, :] = last
            work[tile] = _composite_tile(
                rows, entries, first, last, x0, y0, channels, state, blocks, touched, last_entries[tile]
            )
            _write_tile(state, blocks, x0, y0, stride, image, alpha)
