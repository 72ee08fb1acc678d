"""Front-to-back compositing of footprints, forward.

Tiles are walked in blocks of 4 x 4 pixels, whose 16 lanes fill one or two vector registers. A tile's state lies in one flat
scratch array, block after block, so that it stays in the L1 cache. A set of a tile's blocks is a word with a bit for each.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.instructions import count_bits, lowest_bit, prefetch
from invgraphics.kernels.numba.simd.lanes import any_of, bits_below, counting, exp2_of, load, store, where
from invgraphics.kernels.numba.simd.layouts import write_colour_block, write_grey_block
from invgraphics.kernels.numba.splat.binning import (
    ASPECT,
    FEATURES,
    HIGHEST,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    POWER_XX,
    POWER_XY,
    POWER_YY,
    SHEAR,
    SLACK,
    WIDEST,
    half_span,
)
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

BLOCK = 4
"""Edge of a block in pixels, which are the `LANES`."""
EDGE = 8
"""Most blocks along a tile's edge: what a word has bits for, and what the L1 cache holds."""
BLOCKS = index(EDGE * EDGE)
AHEAD = 16
"""Footprints whose blocks are found before the first of them is drawn."""

_ALPHA_MIN, _ALPHA_MAX = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX)
_STOP = np.float32(TRANSMITTANCE_MIN)
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@inlined
def measure(rows, entries, begin, end, x0, y0, blocks, touched):
    """Write to ``touched`` which of a tile's ``blocks`` a few footprints touch, before any of them is drawn.

    Otherwise a processor would guess how long every row is, and wait for its square roots to learn that it was wrong. Half of
    the lanes find how many blocks of each row begin before the ellipse ends on the right; the others how many end before it
    begins on the left, as if it were turned by 180 degrees.
    """
    numbers, height, half = counting(), np.float32(BLOCK - 1), np.float32(0.5)
    turned = numbers >= np.float32(EDGE)
    side = where(turned, -_ONE, _ONE)
    row = where(turned, numbers - np.float32(EDGE), numbers) * np.float32(BLOCK) + half
    top = where(turned, -row - height, row)
    for entry in range(begin, end):
        prefetch(rows, index(entries[index(min(entry + AHEAD, len(entries) - 1))]))
        r = index(entries[index(entry)])
        x, y, highest = rows[r, MEAN_X] - x0, rows[r, MEAN_Y] - y0, rows[r, HIGHEST]
        shape = rows[r, WIDEST], highest, rows[r, SHEAR], rows[r, ASPECT]
        low = top - side * y
        high = low + height
        width, middle = half_span(shape, min(max(low, shape[0]), high))
        reached = np.floor((middle + width + side * x + (height + half + SLACK)) * np.float32(1.0 / BLOCK))
        counts = min(max(side * reached, _ZERO), np.float32(EDGE))
        begun, passed = bits_below(where((low <= highest) & (high >= -highest), counts, _ZERO))
        touched[index(entry)] = begun & ~passed & blocks


@inlined
def first_of(blocks):
    """The first of a set of blocks, and the set of all others."""
    return lowest_bit(blocks), blocks & (blocks - index(1))


@inlined
def corner(x0, y0, block):
    """First pixel of a block of the tile that begins there."""
    return x0 + np.int64(block % index(EDGE)) * BLOCK, y0 + np.int64(block // index(EDGE)) * BLOCK


@inlined
def placed(rows, r, x0, y0, block):
    """From a footprint's mean to a block's first pixel centre."""
    left, top = corner(x0, y0, block)
    half = np.float32(0.5)
    return np.float32(left) + half - rows[r, MEAN_X], np.float32(top) + half - rows[r, MEAN_Y]


@inlined
def pixels():
    """How far each of a block's pixels lies from its first, across and down."""
    numbers = counting()
    down = np.floor(numbers / np.float32(BLOCK))
    return numbers - down * np.float32(BLOCK), down


@inlined
def inside(x0, y0, edge, width, height):
    """The set of a tile's blocks that have pixels of the image."""
    blocks = index(0)
    for j in range(min(edge, -(-(height - y0) // BLOCK))):
        for i in range(min(edge, -(-(width - x0) // BLOCK))):
            blocks |= index(1) << index(j * EDGE + i)
    return blocks


@inlined
def _open_tile(state, blocks, x0, y0, width, height, stride):
    """Full transmittance on every pixel of the image, and none (-1 marks a finished pixel) outside."""
    across, down = pixels()
    while blocks:
        block, blocks = first_of(blocks)
        base = block * stride
        state[base : base + stride] = _ZERO
        left, top = corner(x0, y0, block)
        in_image = (across < np.float32(width - left)) & (down < np.float32(height - top))
        store(state, base, where(in_image, _ONE, -_ONE))


@inlined
def response_of(shape, opacity, dx, dy):
    """What a footprint answers with to each pixel of a block, at ``dx`` and ``dy`` from its mean; 0 where it cannot be seen."""
    xx, xy, yy = shape
    response = opacity * exp2_of((xx * dx + xy * dy) * dx + yy * dy * dy)
    return where(response >= _ALPHA_MIN, response, _ZERO)


@inlined
def shape_of(rows, r):
    """The exponent's coefficients of a footprint, and its opacity."""
    return (rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]), rows[r, OPACITY]


@inlined
def blended(state, base, response):
    """Composite a footprint onto a block, whose transmittance is in ``state``.

    Returns alpha, the transmittance before, the footprint's weight, and which pixels go on.
    """
    alpha = min(response, _ALPHA_MAX)
    transmittance = load(state, base)
    weight = transmittance * alpha
    after = transmittance - weight
    # Finished pixels carry their final transmittance with a minus sign, so they stay below the limit.
    goes_on = after >= _STOP
    store(state, base, where(goes_on, after, -abs(transmittance)))
    return alpha, transmittance, where(goes_on, weight, _ZERO), goes_on


@inlined
def _draw(state, stride, rows, r, blocks, x0, y0, channels):
    """Composite one footprint onto blocks of a tile; returns those whose pixels are all finished by then."""
    shape, opacity = shape_of(rows, r)
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
    across, down = pixels()
    finished = index(0)
    while blocks:
        block, blocks = first_of(blocks)
        left, top = placed(rows, r, x0, y0, block)
        base = block * stride
        _, _, weight, goes_on = blended(state, base, response_of(shape, opacity, across + left, down + top))
        at = base + LANES
        store(state, at, load(state, at) + weight * red)
        store(state, at + LANES, load(state, at + LANES) + weight * green)
        store(state, at + LANES + LANES, load(state, at + LANES + LANES) + weight * blue)
        for k in range(3, channels):
            at = base + index(1 + k) * LANES
            store(state, at, load(state, at) + weight * rows[r, index(FEATURES + k)])
        finished |= index(0) if any_of(goes_on) else index(1) << block
    return finished


@inlined
def _composite_tile(rows, entries, first, last, x0, y0, channels, state, alive, touched, ends):
    """Walk a tile's footprints front to back until all its pixels are finished; returns the number of blocks visited."""
    stride = LANES * index(1 + channels)
    visits = 0
    for begin in range(first, last, AHEAD):
        end = min(begin + AHEAD, last)
        measure(rows, entries, begin, end, np.float32(x0), np.float32(y0), alive, touched)
        for entry in range(begin, end):
            blocks = touched[index(entry)] & alive
            visits += count_bits(blocks)
            finished = _draw(state, stride, rows, index(entries[index(entry)]), blocks, x0, y0, channels)
            alive ^= finished
            while finished:
                block, finished = first_of(finished)
                ends[block] = entry + 1
        if alive == 0:
            break
    return visits


@inlined
def _write_tile(state, blocks, x0, y0, stride, image, alpha):
    """Copy a tile's sums into the picture."""
    height, width, channels = image.shape
    while blocks:
        block, blocks = first_of(blocks)
        base = block * stride
        left, top = corner(x0, y0, block)
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
def rasterise(rows, entries, starts, bounds, edge, columns, image, alpha, touched, ends, work):
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
        touched: output, per entry the set of blocks that it touches; none behind the last one that was drawn in a tile.
        ends: output, per tile and block, the entry at which all its pixels were finished.
        work: output, blocks visited per tile.
    """
    height, width = alpha.shape
    # Features were filled up to a multiple of three.
    channels = rows.shape[1] - FEATURES
    stride = LANES * index(1 + channels)
    for job in prange(len(bounds) - 1):
        state = np.empty(BLOCKS * stride, np.float32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            blocks = inside(x0, y0, edge, width, height)
            _open_tile(state, blocks, x0, y0, width, height, stride)
            first, last = starts[tile], starts[tile + 1]
            ends[tile, :] = last
            work[tile] = _composite_tile(rows, entries, first, last, x0, y0, channels, state, blocks, touched, ends[tile])
            _write_tile(state, blocks, x0, y0, stride, image, alpha)
