"""Depth sort and tile intersection of footprints: which footprints each tile composites, front to back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.numba.runtime import array, index, inlined, job_start, parallel, prange, scratch, serial, threads
from invgraphics.kernels.numba.simd.instructions import PREFETCH_DISTANCE, prefetch
from invgraphics.kernels.numba.splat.ewa import visible_extent
from invgraphics.kernels.types import ALPHA_MIN, Bins, Footprints

RADIX_BITS = 11
RADIX_PASSES = 3

# Columns of a packed footprint, followed by its features. Its response over (x, y) from the mean is
# opacity 2^(POWER_XX x² + POWER_XY x y + POWER_YY y²).
MEAN_X, MEAN_Y, POWER_XX, POWER_XY, POWER_YY, OPACITY, RIGHTMOST_Y, HALF_HEIGHT, SHEAR, ASPECT, FEATURES = range(11)

HALF_LOG2E = np.float32(-0.5 / np.log(2.0))
"""Turns exp(-q / 2) into 2^(HALF_LOG2E q)."""
MARGIN = np.float32(0.01)
"""Margin in pixels around ellipses in intersection tests, so that rounding never loses a visible pixel."""
MAX_EXTENT = np.float32(1e9)
"""Coordinates and extents beyond this, in pixels, are numerical failures and skipped."""
MIN_CONIC = np.float32(1e-18)
"""Conic entries below this belong to footprints wider than ``MAX_EXTENT``."""


class Packed(NamedTuple):
    """m visible footprints packed front to back, and their tile intersections.

    Attributes:
        order: index of each in the caller's arrays (m,).
        rows: their packed rows (m, FEATURES + c).
        entries: positions in ``order``, tile after tile, front to back.
        starts: first entry of each tile, and the total at the end.
    """

    order: np.ndarray
    rows: np.ndarray
    entries: np.ndarray
    starts: np.ndarray


@serial
def _sort_by_depth(depths, radii, keys, order, keys_swap, order_swap):
    """Indices of footprints with a radius, by depth, ties by index (radix sort of the floats' bits); returns their number."""
    m = 0
    buckets = 1 << RADIX_BITS
    mask = np.uint32(buckets - 1)
    counts = np.zeros((RADIX_PASSES, buckets), np.int64)
    for i in range(len(depths)):
        if radii[i] > 0:
            bits = np.float32(depths[i]).view(np.uint32)
            # Order of the floats as order of unsigned integers: negative ones count backwards.
            key = bits ^ np.uint32(0xFFFFFFFF) if bits >> np.uint32(31) else bits ^ np.uint32(0x80000000)
            keys[m] = key
            order[m] = i
            for p in range(RADIX_PASSES):
                counts[p, (key >> np.uint32(p * RADIX_BITS)) & mask] += 1
            m += 1
    for p in range(RADIX_PASSES):
        total = 0
        for bucket in range(buckets):
            count = counts[p, bucket]
            counts[p, bucket] = total
            total += count
        for i in range(m):
            bucket = (keys[i] >> np.uint32(p * RADIX_BITS)) & mask
            slot = counts[p, bucket]
            counts[p, bucket] = slot + 1
            keys_swap[slot] = keys[i]
            order_swap[slot] = order[i]
        keys, keys_swap = keys_swap, keys
        order, order_swap = order_swap, order
    return m


def depth_order(footprints: Footprints) -> np.ndarray:
    """Indices of the footprints that are not culled, front to back, ties by index; valid until the next call."""
    n = len(footprints)
    keys, keys_swap = scratch("sort keys", n, np.uint32), scratch("sort keys 2", n, np.uint32)
    order, order_swap = scratch("sort order", n, np.int32), scratch("sort order 2", n, np.int32)
    m = _sort_by_depth(array(footprints.depths), array(footprints.radii), keys, order, keys_swap, order_swap)
    return (order_swap if RADIX_PASSES % 2 else order)[:m]


@inlined
def _tile_range(low, high, tile, count):
    """First and last tile that a closed interval of pixel coordinates touches, clipped to ``count``; empty if first > last."""
    first = min(max(np.floor(low / tile), np.float32(0.0)), np.float32(count))
    last = max(min(np.floor(high / tile), np.float32(count - 1)), np.float32(-1.0))
    return np.int32(first), np.int32(last)


@inlined
def _is_regular(x, y, xx, yy, det):
    """Whether a footprint is a finite, proper ellipse; False for NaN."""
    inside = abs(x) < MAX_EXTENT and abs(y) < MAX_EXTENT
    regular = xx > MIN_CONIC and yy > MIN_CONIC and max(xx, yy) < MAX_EXTENT * max(det, np.float32(0.0)) * MAX_EXTENT
    return inside and regular and max(xx, yy) < np.float32(1.0) / MIN_CONIC


@inlined
def _row_range(rows, r, tile, count):
    # A tile's pixel centres begin and end half a pixel inside it.
    half = np.float32(0.5)
    return _tile_range(
        rows[r, MEAN_Y] - rows[r, HALF_HEIGHT] + half, rows[r, MEAN_Y] + rows[r, HALF_HEIGHT] - half, tile, count
    )


@parallel
def _pack(order, means, conics, opacities, features, tile, tile_columns, tile_rows, rows, max_pairs):
    """Pack footprints front to back; degenerate ones get an ellipse of negative height.

    ``max_pairs`` receives, per job, the number of tiles in its footprints' bounding boxes, an upper bound of intersections.
    """
    jobs, edge, half = len(max_pairs), np.float32(tile), np.float32(0.5)
    for job in prange(jobs):
        total = 0
        for r in range(job_start(len(order), jobs, job), job_start(len(order), jobs, job + 1)):
            ahead = index(order[min(r + PREFETCH_DISTANCE, len(order) - 1)])
            prefetch(means, ahead)
            prefetch(conics, ahead)
            prefetch(features, ahead)
            i = index(order[r])
            a, b, c, opacity = conics[i, 0], conics[i, 1], conics[i, 2], opacities[i]
            rows[r, MEAN_X], rows[r, MEAN_Y] = means[i, 0], means[i, 1]
            rows[r, POWER_XX], rows[r, POWER_XY] = HALF_LOG2E * a, (HALF_LOG2E + HALF_LOG2E) * b
            rows[r, POWER_YY], rows[r, OPACITY] = HALF_LOG2E * c, opacity
            rows[r, HALF_HEIGHT] = np.float32(-1.0)
            # In float64: a c - b² cancels for thin footprints.
            det = np.float32(np.float64(a) * np.float64(c) - np.float64(b) * np.float64(b))
            if _is_regular(means[i, 0], means[i, 1], a, c, det) and opacity >= np.float32(ALPHA_MIN):
                # The visible ellipse is a x² + 2 b x y + c y² = `visible_extent`; its rightmost point lies at y = RIGHTMOST_Y.
                size = np.sqrt(visible_extent(opacity) / det)
                rows[r, RIGHTMOST_Y] = -b * size / np.sqrt(c)
                rows[r, HALF_HEIGHT] = np.sqrt(a) * size * np.float32(1.00001) + MARGIN
                rows[r, SHEAR] = -b / a
                rows[r, ASPECT] = np.sqrt(det) / a
                # Upper bound of the ellipse's half-width.
                half_width = rows[r, HALF_HEIGHT] * np.sqrt(c / a) * np.float32(1.00001) + MARGIN + MARGIN
                left, right = _tile_range(means[i, 0] - half_width + half, means[i, 0] + half_width - half, edge, tile_columns)
                top, bottom = _row_range(rows, r, edge, tile_rows)
                total += max(right - left + 1, 0) * max(bottom - top + 1, 0)
            rows[r, FEATURES:] = np.float32(0.0)
            for k in range(features.shape[1]):
                rows[r, FEATURES + k] = features[i, k]
        max_pairs[job] = total


@inlined
def half_span(shape, y):
    """Half-length of the ellipse's horizontal chord at height ``y`` over its centre, and the chord's midpoint.

    ``shape`` holds the packed columns from RIGHTMOST_Y to ASPECT; ``y`` may be a SIMD register.
    """
    _, half_height, shear, aspect = shape
    return aspect * np.sqrt(max(half_height * half_height - y * y, np.float32(0.0))), shear * y


@inlined
def _chord(shape, low, high):
    """Leftmost and rightmost point, relative to the centre, of the ellipse between two heights over its centre."""
    right, left = min(max(shape[0], low), high), min(max(-shape[0], low), high)
    width_right, middle_right = half_span(shape, right)
    width_left, middle_left = half_span(shape, left)
    return middle_left - width_left - MARGIN, middle_right + width_right + MARGIN


@inlined
def _column_range(rows, r, y, tile, count):
    """First and last tile of tile row ``y`` that the ellipse touches (between the first and the last pixel centre)."""
    low = y * tile + np.float32(0.5) - rows[r, MEAN_Y]
    shape = rows[r, RIGHTMOST_Y], rows[r, HALF_HEIGHT], rows[r, SHEAR], rows[r, ASPECT]
    left, right = _chord(shape, low, low + tile - np.float32(1.0))
    x, half = rows[r, MEAN_X], np.float32(0.5)
    return _tile_range(x + left + half, x + right - half, tile, count)


@parallel
def _intersect_ellipses(rows, tile, tile_columns, tile_rows, counts, pairs, pair_counts):
    """Exact ellipse-tile intersection: all pairs (tile, footprint) per job, and their number per tile."""
    jobs, m = counts.shape[0], rows.shape[0]
    edge = np.float32(tile)
    for job in prange(jobs):
        counts[job, :] = 0
        number = 0
        for r in range(job_start(m, jobs, job), job_start(m, jobs, job + 1)):
            if rows[r, HALF_HEIGHT] > 0:
                top, bottom = _row_range(rows, r, edge, tile_rows)
                for y in range(top, bottom + 1):
                    first, last = _column_range(rows, r, np.float32(y), edge, tile_columns)
                    for x in range(first, last + 1):
                        # Guaranteed but for rounding.
                        if number < pairs.shape[2]:
                            t = y * tile_columns + x
                            counts[job, index(t)] += 1
                            pairs[job, 0, index(number)], pairs[job, 1, index(number)] = t, r
                            number += 1
        pair_counts[job] = number


@serial
def _prefix_sum(counts, starts):
    """Exclusive prefix sum of counts over tiles, and over jobs within a tile; returns the total."""
    total = 0
    for t in range(counts.shape[1]):
        starts[t] = total
        for job in range(counts.shape[0]):
            count = counts[job, t]
            counts[job, t] = total
            total += count
    starts[counts.shape[1]] = total
    return total


@parallel
def _write_entries(pairs, pair_counts, cursors, entries):
    """Scatter pairs into tile lists; ``cursors`` holds the position of each job's next entry per tile."""
    for job in prange(len(pair_counts)):
        for k in range(pair_counts[job]):
            t = index(pairs[job, 0, index(k)])
            cursor = cursors[job, t]
            cursors[job, t] = cursor + 1
            entries[index(cursor)] = pairs[job, 1, index(k)]


def pack_and_intersect(
    footprints: Footprints, features: Float[Tensor, "n c"], tile_columns: int, tile_rows: int, tile: int
) -> Packed:
    """Sort visible footprints by depth, pack them, and intersect their visible ellipses with tiles."""
    jobs = threads()
    order = depth_order(footprints).copy()
    # Features are padded to a multiple of three.
    rows = np.empty((len(order), FEATURES + 3 * -(-features.shape[1] // 3)), np.float32)
    means, conics, opacities = array(footprints.means2d), array(footprints.conics), array(footprints.opacities)
    max_pairs, pair_counts = np.empty(jobs, np.int64), np.empty(jobs, np.int64)
    _pack(order, means, conics, opacities, array(features), tile, tile_columns, tile_rows, rows, max_pairs)
    counts = scratch("tile counts", jobs * tile_columns * tile_rows, np.int64).reshape(jobs, tile_columns * tile_rows)
    starts = np.empty(tile_columns * tile_rows + 1, np.int64)
    capacity = int(max_pairs.max())
    pairs = scratch("tile pairs", jobs * 2 * capacity, np.int32).reshape(jobs, 2, capacity)
    _intersect_ellipses(rows, tile, tile_columns, tile_rows, counts, pairs, pair_counts)
    entries = np.empty(_prefix_sum(counts, starts), np.int32)
    _write_entries(pairs, pair_counts, counts, entries)
    return Packed(order, rows, entries, starts)


@serial
def _intersect_squares(order, means, radii, tile, tile_columns, tile_rows, cursors, entries):
    """Count (``entries`` empty) or list the tiles that each footprint's square overlaps, front to back."""
    edge = np.float32(tile)
    for r in range(len(order)):
        i = order[r]
        x, y, radius = means[i, 0], means[i, 1], radii[i]
        if abs(x) < MAX_EXTENT and abs(y) < MAX_EXTENT and radius < MAX_EXTENT:
            left, right = _tile_range(x - radius, x + radius, edge, tile_columns)
            top, bottom = _tile_range(y - radius, y + radius, edge, tile_rows)
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    t = row * tile_columns + column
                    if len(entries):
                        entries[cursors[0, t]] = i
                    cursors[0, t] += 1


def splat_bin(footprints: Footprints, width: int, height: int, tile: int) -> Bins:
    """See `invgraphics.kernels.splat_bin`."""
    tile_columns, tile_rows = -(-width // tile), -(-height // tile)
    order, means, radii = depth_order(footprints), array(footprints.means2d), array(footprints.radii)
    cursors, starts = np.zeros((1, tile_columns * tile_rows), np.int64), np.empty(tile_columns * tile_rows + 1, np.int64)
    _intersect_squares(order, means, radii, tile, tile_columns, tile_rows, cursors, np.empty(0, np.int64))
    entries = np.empty(_prefix_sum(cursors, starts), np.int64)
    if len(entries):
        _intersect_squares(order, means, radii, tile, tile_columns, tile_rows, cursors, entries)
    return Bins(torch.from_numpy(entries), torch.from_numpy(starts), tile, tile_columns, tile_rows)
