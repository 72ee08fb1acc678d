"""Front-to-back compositing of footprints, forward.

Tiles are walked in blocks of 4 x 4 pixels, whose 16 lanes fill one or two vector registers. A tile's state lies in one flat
scratch array, block after block, so that it stays in the L1 cache. A set of a tile's blocks is a word with a bit for
each; ``blocks & (blocks - 1)`` leaves out the first.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.binning import (
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
    WIDEST,
    chord,
)
from invgraphics.kernels.numba.instructions import lowest_bit, prefetch
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, parallel, prange
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
_NO_FEATURES = (_ZERO, _ZERO, _ZERO)


@inlined
def measure(rows, entries, begin, end, x0, y0, edge, touched):
    """Write to ``touched`` which blocks of a tile a few footprints touch, before any of them is drawn.

    Otherwise a processor would guess how long every row is, and wait for its square roots to learn that it was wrong.
    """
    quarter, most = np.float32(1.0 / BLOCK), np.float32(edge)
    before, after = np.float32(0.5 - BLOCK) * quarter, np.float32(-0.5) * quarter + _ONE
    for entry in range(begin, end):
        prefetch(rows, index(entries[index(min(entry + AHEAD, len(entries) - 1))]))
        r = index(entries[index(entry)])
        x, y, highest = (rows[r, MEAN_X] - x0) * quarter, rows[r, MEAN_Y] - y0, rows[r, HIGHEST]
        shape = rows[r, WIDEST], highest, rows[r, SHEAR], rows[r, ASPECT]
        blocks = index(0)
        for j in range(edge):
            low = np.float32(np.int32(j)) * np.float32(BLOCK) + np.float32(0.5) - y
            high = low + np.float32(BLOCK - 1)
            left, right = chord(shape, low, high)
            first = np.int32(np.ceil(min(max(x + left * quarter + before, _ZERO), most)))
            past = np.int32(np.floor(max(min(x + right * quarter + after, most), _ZERO)))
            row = max(np.int32(1 << past) - np.int32(1 << first), np.int32(0))
            row = row if low <= highest and high >= -highest else np.int32(0)
            blocks |= index(row) << index(j * EDGE)
        touched[index(entry)] = blocks


@inlined
def placed(rows, r, x0, y0, block):
    """From a footprint's mean to a block's first pixel centre."""
    dx = np.float32(np.int32(x0) + np.int32(block % index(EDGE)) * np.int32(BLOCK)) + np.float32(0.5) - rows[r, MEAN_X]
    dy = np.float32(np.int32(y0) + np.int32(block // index(EDGE)) * np.int32(BLOCK)) + np.float32(0.5) - rows[r, MEAN_Y]
    return dx, dy


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
    while blocks:
        block = lowest_bit(blocks)
        blocks &= blocks - index(1)
        base = block * stride
        state[base : base + stride] = _ZERO
        right = np.int32(width - x0) - np.int32(block % index(EDGE)) * np.int32(BLOCK)
        below = np.int32(height - y0) - np.int32(block // index(EDGE)) * np.int32(BLOCK)
        for lane in range(BLOCK * BLOCK):
            # No branch: vector registers hold a whole row of a block.
            outside = (np.int32(lane % BLOCK) >= right) | (np.int32(lane // BLOCK) >= below)
            state[base + index(lane)] = -_ONE if outside else _ONE


@inlined
def _blend(state, base, rows, r, dx0, dy0, triples, fused):
    """Composite one footprint onto one block; returns how many of its pixels are unfinished (as a float: it vectorises).

    ``fused`` is how many of the triples of channels the loop takes along: a literal, for which LLVM drops what is not used.
    """
    xx, xy, yy = rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]
    opacity = rows[r, OPACITY]
    first, second, third = _three_features(rows, r, 0), _NO_FEATURES, _NO_FEATURES
    if fused > 1:
        second = _three_features(rows, r, 1)
    if fused > 2:
        third = _three_features(rows, r, 2)
    unfinished = _ZERO
    for lane in range(LANES):
        dx = dx0 + np.float32(lane & index(3))
        dy = dy0 + np.float32(lane >> index(2))
        response = opacity * exp2(xx * dx * dx + xy * dx * dy + yy * dy * dy)
        alpha = min(response if response >= _ALPHA_MIN else _ZERO, _ALPHA_MAX)
        transmittance = state[base + lane]
        weight = transmittance * alpha
        after = transmittance - weight
        # Finished pixels carry their final transmittance with a minus sign, so they stay below the limit.
        goes_on = after >= _STOP
        weight = weight if goes_on else _ZERO
        state[base + lane] = after if goes_on else -abs(transmittance)
        state[base + LANES + lane] = weight
        _add(state, base + index(2) * LANES + lane, weight, first)
        if fused > 1:
            _add(state, base + index(5) * LANES + lane, weight, second)
        if fused > 2:
            _add(state, base + index(8) * LANES + lane, weight, third)
        unfinished += _ONE if goes_on else _ZERO
    for k in range(fused, triples):
        more = _three_features(rows, r, k)
        for lane in range(LANES):
            _add(state, base + index(2 + 3 * k) * LANES + lane, state[base + LANES + lane], more)
    return unfinished


@inlined
def _three_features(rows, r, k):
    """A triple of a footprint's features."""
    column = index(FEATURES + 3 * k)
    return rows[r, column], rows[r, column + index(1)], rows[r, column + index(2)]


@inlined
def _add(state, at, weight, values):
    """Add three weighted channels of one pixel to its sums."""
    state[at] += weight * values[0]
    state[at + LANES] += weight * values[1]
    state[at + LANES + LANES] += weight * values[2]


@inlined
def _composite_tile(rows, entries, first, last, x0, y0, edge, triples, state, alive, touched, ends):
    """Walk a tile's footprints front to back until all its pixels are finished; returns the number of blocks visited."""
    stride = LANES * index(2 + 3 * triples)
    visits = 0
    for begin in range(first, last, AHEAD):
        end = min(begin + AHEAD, last)
        measure(rows, entries, begin, end, np.float32(x0), np.float32(y0), edge, touched)
        for entry in range(begin, end):
            r, blocks = index(entries[index(entry)]), touched[index(entry)] & alive
            while blocks:
                block = lowest_bit(blocks)
                dx, dy = placed(rows, r, x0, y0, block)
                visits += 1
                base = block * stride
                # Colours alone, with a depth, and with a normal: each has a loop of its own.
                if triples == 1:
                    unfinished = _blend(state, base, rows, r, dx, dy, triples, 1)
                elif triples == 2:
                    unfinished = _blend(state, base, rows, r, dx, dy, triples, 2)
                else:
                    unfinished = _blend(state, base, rows, r, dx, dy, triples, 3)
                if unfinished == 0:
                    alive ^= index(1) << block
                    ends[block] = entry + 1
                blocks &= blocks - index(1)
        if alive == 0:
            break
    return visits


@inlined
def _write_tile(state, x0, y0, edge, stride, image, alpha):
    """Copy a tile's sums into the picture."""
    height, width, channels = image.shape
    for j in range(edge):
        for i in range(edge):
            left, top = x0 + i * BLOCK, y0 + j * BLOCK
            for row in range(min(BLOCK, height - top)):
                for column in range(min(BLOCK, width - left)):
                    y, x = index(top + row), index(left + column)
                    at = index(j * EDGE + i) * stride + index(row * BLOCK + column)
                    alpha[y, x] = _ONE - abs(state[at])
                    if channels == 3:
                        image[y, x, index(0)] = state[at + index(2) * LANES]
                        image[y, x, index(1)] = state[at + index(3) * LANES]
                        image[y, x, index(2)] = state[at + index(4) * LANES]
                    else:
                        for k in range(channels):
                            image[y, x, index(k)] = state[at + index(2 + k) * LANES]


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
    triples = (rows.shape[1] - FEATURES) // 3
    stride = LANES * index(2 + 3 * triples)
    for job in prange(len(bounds) - 1):
        state = np.empty(BLOCKS * stride, np.float32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            alive = inside(x0, y0, edge, width, height)
            _open_tile(state, alive, x0, y0, width, height, stride)
            first, last = starts[tile], starts[tile + 1]
            ends[tile, :] = last
            work[tile] = _composite_tile(rows, entries, first, last, x0, y0, edge, triples, state, alive, touched, ends[tile])
            _write_tile(state, x0, y0, edge, stride, image, alpha)
