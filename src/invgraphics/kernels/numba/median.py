"""Depth at which half of the light is gone: the forward walk of `raster`, without colours."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.binning import FEATURES, OPACITY, POWER_XX, POWER_XY, POWER_YY
from invgraphics.kernels.numba.instructions import lowest_bit
from invgraphics.kernels.numba.raster import AHEAD, BLOCK, BLOCKS, EDGE, inside, measure, placed
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, parallel, prange
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN

_ALPHA_MIN, _ALPHA_MAX = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX)
_ONE, _ZERO, _HALF = np.float32(1.0), np.float32(0.0), np.float32(0.5)


@inlined
def _hide(transmittance, distance, base, rows, r, dx0, dy0):
    """Lower the transmittance of one block; where it crosses 1/2, note the footprint's distance. Returns the open pixels."""
    xx, xy, yy = rows[r, POWER_XX], rows[r, POWER_XY], rows[r, POWER_YY]
    still_open = _ZERO
    for lane in range(LANES):
        dx = dx0 + np.float32(lane & index(3))
        dy = dy0 + np.float32(lane >> index(2))
        alpha = min(rows[r, OPACITY] * exp2(xx * dx * dx + xy * dx * dy + yy * dy * dy), _ALPHA_MAX)
        alpha = alpha if alpha >= _ALPHA_MIN else _ZERO
        before = transmittance[base + lane]
        after = before * (_ONE - alpha)
        here = rows[r, FEATURES] + rows[r, FEATURES + 1] * dx + rows[r, FEATURES + 2] * dy
        distance[base + lane] = here if before > _HALF and after <= _HALF else distance[base + lane]
        transmittance[base + lane] = after
        still_open += _ONE if after > _HALF else _ZERO
    return still_open


@inlined
def _walk(rows, entries, first, last, x0, y0, edge, transmittance, distance, is_open, touched):
    """Walk a tile's footprints front to back until no pixel is open."""
    for begin in range(first, last, AHEAD):
        end = min(begin + AHEAD, last)
        measure(rows, entries, begin, end, np.float32(x0), np.float32(y0), edge, touched)
        for entry in range(begin, end):
            r, blocks = index(entries[index(entry)]), touched[index(entry)] & is_open
            while blocks:
                block = lowest_bit(blocks)
                dx, dy = placed(rows, r, x0, y0, block)
                if _hide(transmittance, distance, block * LANES, rows, r, dx, dy) == _ZERO:
                    is_open ^= index(1) << block
                blocks &= blocks - index(1)
        if is_open == 0:
            break


@parallel
def median(rows, entries, starts, bounds, edge, columns, touched, depth):
    """Write where each pixel's transmittance falls to 1/2 (arguments as in `rasterise`; features are the planes).

    ``depth`` (h, w) holds inf and keeps it where the transmittance stays above.
    """
    height, width = depth.shape
    for job in prange(len(bounds) - 1):
        transmittance, distance = np.empty(BLOCKS * LANES, np.float32), np.empty(BLOCKS * LANES, np.float32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            transmittance[:] = _ONE
            distance[:] = np.inf
            first, last, blocks = starts[tile], starts[tile + 1], inside(x0, y0, edge, width, height)
            _walk(rows, entries, first, last, x0, y0, edge, transmittance, distance, blocks, touched)
            for y in range(y0, min(y0 + edge * BLOCK, height)):
                for x in range(x0, min(x0 + edge * BLOCK, width)):
                    block = (y - y0) // BLOCK * EDGE + (x - x0) // BLOCK
                    depth[index(y), index(x)] = distance[block * BLOCK * BLOCK + (y - y0) % BLOCK * BLOCK + (x - x0) % BLOCK]
