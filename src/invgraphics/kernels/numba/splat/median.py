"""Median depth: the forward pass of `raster` without colours; distance at which transmittance falls to 1/2."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined, parallel, prange
from invgraphics.kernels.numba.simd.lanes import any_of, load, store, where
from invgraphics.kernels.numba.splat.binning import FEATURES
from invgraphics.kernels.numba.splat.raster import (
    BATCH,
    BLOCK,
    BLOCKS,
    EDGE,
    block_offset,
    exponent_of,
    gaussian_response,
    image_blocks,
    overlapped_blocks,
    pixel_offsets,
    pop_block,
)
from invgraphics.kernels.types import ALPHA_MAX

_ALPHA_MAX = np.float32(ALPHA_MAX)
_ONE, _ZERO, _HALF = np.float32(1.0), np.float32(0.0), np.float32(0.5)


@inlined
def _attenuate(transmittance, distance, rows, r, blocks, x0, y0):
    """Attenuate blocks by a footprint, recording the distance where transmittance crosses 1/2; returns the finished blocks."""
    exponent, opacity = exponent_of(rows, r)
    across, down = pixel_offsets()
    finished = index(0)
    while blocks:
        block, blocks = pop_block(blocks)
        left, top = block_offset(rows, r, x0, y0, block)
        dx, dy, base = across + left, down + top, block * LANES
        before = load(transmittance, base)
        after = before * (_ONE - min(gaussian_response(exponent, opacity, dx, dy), _ALPHA_MAX))
        t = rows[r, FEATURES] + rows[r, FEATURES + 1] * dx + rows[r, FEATURES + 2] * dy
        store(distance, base, where((before > _HALF) & (after <= _HALF), t, load(distance, base)))
        store(transmittance, base, after)
        finished |= index(0) if any_of(after > _HALF) else index(1) << block
    return finished


@inlined
def _median_tile(rows, entries, first, last, x0, y0, transmittance, distance, active_blocks, touched):
    """Traverse a tile's footprints front to back until every pixel has its median."""
    for begin in range(first, last, BATCH):
        end = min(begin + BATCH, last)
        overlapped_blocks(rows, entries, begin, end, np.float32(x0), np.float32(y0), active_blocks, touched)
        for entry in range(begin, end):
            r, blocks = index(entries[index(entry)]), touched[index(entry)] & active_blocks
            active_blocks ^= _attenuate(transmittance, distance, rows, r, blocks, x0, y0)
        if active_blocks == 0:
            break


@parallel
def median(rows, entries, starts, bounds, edge, columns, touched, depth):
    """Median depth of every pixel to ``depth`` (h, w), which holds inf before and keeps it where transmittance stays above 1/2.

    Arguments as in `rasterise`; features are the depth planes.
    """
    height, width = depth.shape
    for job in prange(len(bounds) - 1):
        transmittance, distance = np.empty(BLOCKS * LANES, np.float32), np.empty(BLOCKS * LANES, np.float32)
        for tile in range(bounds[job], bounds[job + 1]):
            x0, y0 = tile % columns * edge * BLOCK, tile // columns * edge * BLOCK
            transmittance[:] = _ONE
            distance[:] = np.inf
            first, last, blocks = starts[tile], starts[tile + 1], image_blocks(x0, y0, edge, width, height)
            _median_tile(rows, entries, first, last, x0, y0, transmittance, distance, blocks, touched)
            for y in range(y0, min(y0 + edge * BLOCK, height)):
                for x in range(x0, min(x0 + edge * BLOCK, width)):
                    block = (y - y0) // BLOCK * EDGE + (x - x0) // BLOCK
                    depth[index(y), index(x)] = distance[block * BLOCK * BLOCK + (y - y0) % BLOCK * BLOCK + (x - x0) % BLOCK]
