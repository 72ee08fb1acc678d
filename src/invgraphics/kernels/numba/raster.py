"""Front-to-back compositing of footprints, forward.

Tiles are walked in blocks of 4 x 4 pixels, whose 16 lanes fill one or two vector registers. A tile's state lies in one flat
scratch array, block after block, so that it stays in the L1 cache.
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
from invgraphics.kernels.numba.runtime import exp2, index, inlined, parallel, prange
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

BLOCK = 4
"""Edge of a block in pixels."""
LANES = index(BLOCK * BLOCK)
AHEAD = 16
"""Footprints whose blocks are found before the first of them is drawn."""

_ALPHA_MIN, _ALPHA_MAX = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX)
_STOP = np.float32(TRANSMITTANCE_MIN)
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@inlined
def _pair(first, last, edge):
    """The whole numbers from ``first`` to ``last``, clipped to a tile, as one; `span` takes them apart."""
    low = np.int32(np.ceil(min(max(first, _ZERO), np.float32(edge))))
    high = np.int32(np.floor(max(min(last, np.float32(edge - 1)), -_ONE)))
    return np.int32(np.int32(high << np.int32(16)) | low)


@inlined
def span(pair):
    """First and last block; none if they are the wrong way round."""
    return pair & np.int32(0xFFFF), pair >> np.int32(16)


@inlined
def measure(rows, entries, begin, end, x0, y0, edge, spans):
    """Find which blocks of a tile a few footprints touch before any of them is drawn.

    Otherwise a processor would guess how long every row is, and wait for its square roots to learn that it was wrong.

    ``spans`` (`AHEAD`, edge + 1) receives the rows of blocks, and the blocks of each row.
    """
    quarter = np.float32(1.0 / BLOCK)
    first, last = np.float32(0.5 - BLOCK) * quarter, np.float32(-0.5) * quarter
    for entry in range(begin, end):
        r, n = index(entries[index(entry)]), index(entry - begin)
        x, y, highest = (rows[r, MEAN_X] - x0) * quarter, rows[r, MEAN_Y] - y0, rows[r, HIGHEST]
        spans[n, edge] = _pair((y - highest) * quarter + first, (y + highest) * quarter + last, edge)
        shape = rows[r, WIDEST], highest, rows[r, SHEAR], rows[r, ASPECT]
        for number in range(edge):
            low = np.float32(np.int32(number)) * np.float32(BLOCK) + np.float32(0.5) - y
            left, right = chord(shape, low, low + np.float32(BLOCK - 1))
            spans[n, index(number)] = _pair(x + left * quarter + first, x + right * quarter + last, edge)


@inlined
def open_tile(state, alive, x0, y0, edge, width, height, stride):
    """Full transmittance on every pixel of the image, and none (-1 marks a finished pixel) outside; returns live blocks."""
    live = 0
    for j in range(edge):
        for i in range(edge):
            block = index(j * edge + i)
            inside = x0 + i * BLOCK < width and y0 + j * BLOCK < height
            alive[block] = inside
            live += inside
            state[block * stride : (block + index(1)) * stride] = _ZERO
            right, below = np.int32(width - x0 - i * BLOCK), np.int32(height - y0 - j * BLOCK)
            for lane in range(BLOCK * BLOCK):
                # No branch: vector registers hold a whole row of a block.
                outside = (np.int32(lane % BLOCK) >= right) | (np.int32(lane // BLOCK) >= below)
                state[block * stride + index(lane)] = -_ONE if outside else _ONE
    return live


@inlined
def _blend(state, base, rows, r, dx0, dy0, triples):
    """Composite one footprint onto one block; returns how many of its pixels are unfinished (as a float: it vectorises)."""
    xx, xy, yy = rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]
    opacity = rows[r, OPACITY]
    red, green, blue = rows[r, FEATURES], rows[r, FEATURES + 1], rows[r, FEATURES + 2]
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
        state[base + index(2) * LANES + lane] += weight * red
        state[base + index(3) * LANES + lane] += weight * green
        state[base + index(4) * LANES + lane] += weight * blue
        unfinished += _ONE if goes_on else _ZERO
    for k in range(1, triples):
        _blend_more(state, base, index(2 + 3 * k) * LANES, rows, r, index(FEATURES + 3 * k))
    return unfinished


@inlined
def _blend_more(state, base, to, rows, r, k):
    """Add three further channels with the weights that `_blend` left behind."""
    first, second, third = rows[r, k], rows[r, k + index(1)], rows[r, k + index(2)]
    for lane in range(LANES):
        weight = state[base + LANES + lane]
        state[base + to + lane] += weight * first
        state[base + to + LANES + lane] += weight * second
        state[base + to + LANES + LANES + lane] += weight * third


@inlined
def _composite_tile(rows, entries, first, last, x0, y0, edge, triples, state, alive, spans, ends, live):
    """Walk a tile's footprints front to back until all its pixels are finished; returns the number of blocks visited."""
    stride = LANES * index(2 + 3 * triples)
    half = np.float32(0.5)
    ox, oy = np.float32(x0), np.float32(y0)
    visits = 0
    for begin in range(first, last, AHEAD):
        end = min(begin + AHEAD, last)
        measure(rows, entries, begin, end, ox, oy, edge, spans)
        for entry in range(begin, end):
            r, n = index(entries[index(entry)]), index(entry - begin)
            top, bottom = span(spans[n, edge])
            for j in range(top, bottom + 1):
                left, right = span(spans[n, index(j)])
                for i in range(left, right + 1):
                    block = index(j * edge + i)
                    if alive[block]:
                        visits += 1
                        dx = ox + np.float32(i * BLOCK) + half - rows[r, MEAN_X]
                        dy = oy + np.float32(j * BLOCK) + half - rows[r, MEAN_Y]
                        if _blend(state, block * stride, rows, r, dx, dy, triples) == 0:
                            alive[block] = False
                            ends[block] = entry + 1
                            live -= 1
        if live == 0:
            break
    return visits


@inlined
def _write_tile(state, x0, y0, edge, stride, image, alpha):
    """Copy a tile's sums into the picture."""
    height, width, channels = image.shape
    for block in range(edge * edge):
        left, top = x0 + block % edge * BLOCK, y0 + block // edge * BLOCK
        for row in range(min(BLOCK, height - top)):
            for column in range(min(BLOCK, width - left)):
                y, x = index(top + row), index(left + column)
                at = index(block) * stride + index(row * BLOCK + column)
                alpha[y, x] = _ONE - abs(state[at])
                if channels == 3:
                    image[y, x, index(0)] = state[at + index(2) * LANES]
                    image[y, x, index(1)] = state[at + index(3) * LANES]
                    image[y, x, index(2)] = state[at + index(4) * LANES]
                else:
                    for k in range(channels):
                        image[y, x, index(k)] = state[at + index(2 + k) * LANES]


@parallel
def rasterise(rows, entries, starts, bounds, edge, columns, image, alpha, ends, work):
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
        ends: output, per tile and block, the entry at which all its pixels were finished.
        work: output, blocks visited per tile.
    """
    height, width = alpha.shape
    triples = (rows.shape[1] - FEATURES) // 3
    stride = LANES * index(2 + 3 * triples)
    for job in prange(len(bounds) - 1):
        state = np.empty(index(edge * edge) * stride, np.float32)
        alive, spans = np.empty(edge * edge, np.bool_), np.empty((AHEAD, edge + 1), np.int32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            live = open_tile(state, alive, x0, y0, edge, width, height, stride)
            first, last = starts[tile], starts[tile + 1]
            ends[tile, :] = last
            work[tile] = _composite_tile(
                rows, entries, first, last, x0, y0, edge, triples, state, alive, spans, ends[tile], live
            )
            _write_tile(state, x0, y0, edge, stride, image, alpha)
