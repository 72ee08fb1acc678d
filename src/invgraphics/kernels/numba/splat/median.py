"""Depth at which half of the light is gone: the forward walk of `raster`, without colours."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.lanes import any_of, load, store, where
from invgraphics.kernels.numba.splat.binning import FEATURES
from invgraphics.kernels.numba.splat.raster import (
    AHEAD,
    BLOCK,
    BLOCKS,
    EDGE,
    first_of,
    inside,
    measure,
    pixels,
    placed,
    response_of,
    shape_of,
)
from invgraphics.kernels.types import ALPHA_MAX

_ALPHA_MAX = np.float32(ALPHA_MAX)
_ONE, _ZERO, _HALF = np.float32(1.0), np.float32(0.0), np.float32(0.5)


@inlined
def _hide(transmittance, distance, rows, r, blocks, x0, y0):
    """Lower the transmittance of blocks, and note the distance where it crosses 1/2; returns those without open pixels."""
    shape, opacity = shape_of(rows, r)
    across, down = pixels()
    closed = index(0)
    while blocks:
        block, blocks = first_of(blocks)
        left, top = placed(rows, r, x0, y0, block)
        dx, dy, base = across + left, down + top, block * LANES
        before = load(transmittance, base)
        after = before * (_ONE - min(response_of(shape, opacity, dx, dy), _ALPHA_MAX))
        here = rows[r, FEATURES] + rows[r, FEATURES + 1] * dx + rows[r, FEATURES + 2] * dy
        store(distance, base, where((before > _HALF) & (after <= _HALF), here, load(distance, base)))
        store(transmittance, base, after)
        closed |= index(0) if any_of(after > _HALF) else index(1) << block
    return closed


@inlined
def _walk(rows, entries, first, last, x0, y0, transmittance, distance, is_open, touched):
    """Walk a tile's footprints front to back until no pixel is open."""
    for begin in range(first, last, AHEAD):
        end = min(begin + AHEAD, last)
        measure(rows, entries, begin, end, np.float32(x0), np.float32(y0), is_open, touched)
        for entry in range(begin, end):
            r, blocks = index(entries[index(entry)]), touched[index(entry)] & is_open
            is_open ^= _hide(transmittance, distance, rows, r, blocks, x0, y0)
        if is_open == 0:
            break


@parallel
def median(rows, entries, starts, bounds, edge, columns, touched, depth):
    """Write where each pixel's transmittance falls to 1/2 (arguments as in `rasterise`; features are the depth planes).

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
            _walk(rows, entries, first, last, x0, y0, transmittance, distance, blocks, touched)
            for y in range(y0, min(y0 + edge * BLOCK, height)):
                for x in range(x0, min(x0 + edge * BLOCK, width)):
                    block = (y - y0) // BLOCK * EDGE + (x - x0) // BLOCK
                    depth[index(y), index(x)] = distance[block * BLOCK * BLOCK + (y - y0) % BLOCK * BLOCK + (x - x0) % BLOCK]
