"""Depth sort and tile lists of footprints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.numba.runtime import array, index, inlined, parallel, prange, scratch, serial, share, threads
from invgraphics.kernels.numba.simd.instructions import SOON, prefetch
from invgraphics.kernels.numba.splat.ewa import reach_of
from invgraphics.kernels.types import ALPHA_MIN, Bins, Footprints

RADIX_BITS = 11
RADIX_PASSES = 3

# A packed row: what rasterising a footprint needs, followed by its features. Its response over (x, y) from the mean is
# opacity 2^(POWER_XX x² + POWER_XY x y + POWER_YY y²).
MEAN_X, MEAN_Y, POWER_XX, POWER_XY, POWER_YY, OPACITY, WIDEST, HIGHEST, SHEAR, ASPECT, FEATURES = range(11)

HALF_LOG2E = np.float32(-0.5 / np.log(2.0))
"""Turns exp(-q / 2) into 2^(HALF_LOG2E q)."""
SLACK = np.float32(0.01)
"""Pixels by which ellipses are widened when blocks are chosen, so that rounding never loses a visible pixel."""
LARGEST = np.float32(1e9)
"""Coordinates and extents beyond this, in pixels, are taken for numerical failures and skipped."""
SMALLEST = np.float32(1e-18)
"""Entries of conics below this belong to footprints wider than ``LARGEST``."""


class Packed(NamedTuple):
    """m visible footprints front to back, and the tiles they touch.

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
def _sort_by_depth(depths, radii, keys, order, keys_other, order_other):
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
            to = counts[p, bucket]
            counts[p, bucket] = to + 1
            keys_other[to] = keys[i]
            order_other[to] = order[i]
        keys, keys_other = keys_other, keys
        order, order_other = order_other, order
    return m


def depth_order(footprints: Footprints) -> np.ndarray:
    """Indices of the footprints that are not culled, front to back, ties by index; valid until the next call."""
    n = len(footprints)
    keys, keys_other = scratch("sort keys", n, np.uint32), scratch("sort keys 2", n, np.uint32)
    order, order_other = scratch("sort order", n, np.int32), scratch("sort order 2", n, np.int32)
    m = _sort_by_depth(array(footprints.depths), array(footprints.radii), keys, order, keys_other, order_other)
    return (order_other if RADIX_PASSES % 2 else order)[:m]


@inlined
def _tiles(low, high, tile, count):
    """Tiles that the closed interval of pixel coordinates touches, clipped to ``count``; empty if first > last."""
    first = min(max(np.floor(low / tile), np.float32(0.0)), np.float32(count))
    last = max(min(np.floor(high / tile), np.float32(count - 1)), np.float32(-1.0))
    return np.int32(first), np.int32(last)


@inlined
def _drawable(x, y, xx, yy, det):
    """Whether a footprint is finite and a proper ellipse; written so that NaN says no."""
    inside = abs(x) < LARGEST and abs(y) < LARGEST
    regular = xx > SMALLEST and yy > SMALLEST and max(xx, yy) < LARGEST * max(det, np.float32(0.0)) * LARGEST
    return inside and regular and max(xx, yy) < np.float32(1.0) / SMALLEST


@inlined
def _tile_rows(rows, r, tile, count):
    # A tile's pixel centres begin and end half a pixel inside it.
    half = np.float32(0.5)
    return _tiles(rows[r, MEAN_Y] - rows[r, HIGHEST] + half, rows[r, MEAN_Y] + rows[r, HIGHEST] - half, tile, count)


@parallel
def _pack(order, means, conics, opacities, features, tile, columns, lines, rows, most):
    """Gather footprints front to back; those that cannot be drawn get an ellipse of negative height.

    ``most`` receives, per job, in how many tiles its footprints' boxes lie: they touch no more.
    """
    jobs, edge, half = len(most), np.float32(tile), np.float32(0.5)
    for job in prange(jobs):
        total = 0
        for r in range(share(len(order), jobs, job), share(len(order), jobs, job + 1)):
            ahead = index(order[min(r + SOON, len(order) - 1)])
            prefetch(means, ahead)
            prefetch(conics, ahead)
            prefetch(features, ahead)
            i = index(order[r])
            a, b, c, opacity = conics[i, 0], conics[i, 1], conics[i, 2], opacities[i]
            rows[r, MEAN_X], rows[r, MEAN_Y] = means[i, 0], means[i, 1]
            rows[r, POWER_XX], rows[r, POWER_XY] = HALF_LOG2E * a, (HALF_LOG2E + HALF_LOG2E) * b
            rows[r, POWER_YY], rows[r, OPACITY] = HALF_LOG2E * c, opacity
            rows[r, HIGHEST] = np.float32(-1.0)
            # In float64: a c - b² cancels for thin footprints.
            det = np.float32(np.float64(a) * np.float64(c) - np.float64(b) * np.float64(b))
            if _drawable(means[i, 0], means[i, 1], a, c, det) and opacity >= np.float32(ALPHA_MIN):
                # The visible ellipse is a x² + 2 b x y + c y² = `reach_of`; its rightmost point lies at y = WIDEST.
                size = np.sqrt(reach_of(opacity) / det)
                rows[r, WIDEST] = -b * size / np.sqrt(c)
                rows[r, HIGHEST] = np.sqrt(a) * size * np.float32(1.00001) + SLACK
                rows[r, SHEAR] = -b / a
                rows[r, ASPECT] = np.sqrt(det) / a
                # No chord of the ellipse that high reaches farther.
                wide = rows[r, HIGHEST] * np.sqrt(c / a) * np.float32(1.00001) + SLACK + SLACK
                left, right = _tiles(means[i, 0] - wide + half, means[i, 0] + wide - half, edge, columns)
                top, bottom = _tile_rows(rows, r, edge, lines)
                total += max(right - left + 1, 0) * max(bottom - top + 1, 0)
            rows[r, FEATURES:] = np.float32(0.0)
            for k in range(features.shape[1]):
                rows[r, FEATURES + k] = features[i, k]
        most[job] = total


@inlined
def half_span(shape, y):
    """Half the ellipse's width at height ``y`` over its centre, and the offset of that chord's middle.

    ``shape`` is what `_pack` wrote to the columns from WIDEST to ASPECT; ``y`` may be a register.
    """
    _, highest, shear, aspect = shape
    return aspect * np.sqrt(max(highest * highest - y * y, np.float32(0.0))), shear * y


@inlined
def _chord(shape, low, high):
    """Leftmost and rightmost point, relative to the centre, of the ellipse between two heights over its centre."""
    right, left = min(max(shape[0], low), high), min(max(-shape[0], low), high)
    width_right, middle_right = half_span(shape, right)
    width_left, middle_left = half_span(shape, left)
    return middle_left - width_left - SLACK, middle_right + width_right + SLACK


@inlined
def _tile_columns(rows, r, y, tile, count):
    """Tiles of tile row ``y`` that the ellipse touches (between the first and the last pixel centre)."""
    low = y * tile + np.float32(0.5) - rows[r, MEAN_Y]
    shape = rows[r, WIDEST], rows[r, HIGHEST], rows[r, SHEAR], rows[r, ASPECT]
    left, right = _chord(shape, low, low + tile - np.float32(1.0))
    x, half = rows[r, MEAN_X], np.float32(0.5)
    return _tiles(x + left + half, x + right - half, tile, count)


@parallel
def _count(rows, tile, columns, lines, counts, pairs, found):
    """Per job, how many of its footprints touch each tile; and all pairs of a tile and a footprint that touches it."""
    jobs, m = counts.shape[0], rows.shape[0]
    edge = np.float32(tile)
    for job in prange(jobs):
        counts[job, :] = 0
        number = 0
        for r in range(share(m, jobs, job), share(m, jobs, job + 1)):
            if rows[r, HIGHEST] > 0:
                top, bottom = _tile_rows(rows, r, edge, lines)
                for y in range(top, bottom + 1):
                    first, last = _tile_columns(rows, r, np.float32(y), edge, columns)
                    for x in range(first, last + 1):
                        # Always so, but for what rounding might do.
                        if number < pairs.shape[2]:
                            t = y * columns + x
                            counts[job, index(t)] += 1
                            pairs[job, 0, index(number)], pairs[job, 1, index(number)] = t, r
                            number += 1
        found[job] = number


@serial
def _running_totals(counts, starts):
    """Turn counts into places: tile after tile, within a tile job after job."""
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
def _list(pairs, found, places, entries):
    """Write each footprint to the tiles it touches; ``places`` says where each job's next entry of a tile goes."""
    for job in prange(len(found)):
        for k in range(found[job]):
            t = index(pairs[job, 0, index(k)])
            place = places[job, t]
            places[job, t] = place + 1
            entries[index(place)] = pairs[job, 1, index(k)]


def pack(footprints: Footprints, features: Float[Tensor, "n c"], columns: int, lines: int, tile: int) -> Packed:
    """Sort visible footprints by depth and list, per tile, those whose visible ellipse touches it."""
    jobs = threads()
    order = depth_order(footprints).copy()
    # Features are handled three at a time.
    rows = np.empty((len(order), FEATURES + 3 * -(-features.shape[1] // 3)), np.float32)
    means, conics, opacities = array(footprints.means2d), array(footprints.conics), array(footprints.opacities)
    most, found = np.empty(jobs, np.int64), np.empty(jobs, np.int64)
    _pack(order, means, conics, opacities, array(features), tile, columns, lines, rows, most)
    counts = scratch("tile counts", jobs * columns * lines, np.int64).reshape(jobs, columns * lines)
    starts = np.empty(columns * lines + 1, np.int64)
    room = int(most.max())
    pairs = scratch("tile pairs", jobs * 2 * room, np.int32).reshape(jobs, 2, room)
    _count(rows, tile, columns, lines, counts, pairs, found)
    entries = np.empty(_running_totals(counts, starts), np.int32)
    _list(pairs, found, counts, entries)
    return Packed(order, rows, entries, starts)


@serial
def _squares(order, means, radii, tile, columns, lines, places, entries):
    """Count (``entries`` empty) or list the tiles each footprint's square touches, front to back."""
    edge = np.float32(tile)
    for r in range(len(order)):
        i = order[r]
        x, y, radius = means[i, 0], means[i, 1], radii[i]
        if abs(x) < LARGEST and abs(y) < LARGEST and radius < LARGEST:
            left, right = _tiles(x - radius, x + radius, edge, columns)
            top, bottom = _tiles(y - radius, y + radius, edge, lines)
            for line in range(top, bottom + 1):
                for column in range(left, right + 1):
                    t = line * columns + column
                    if len(entries):
                        entries[places[0, t]] = i
                    places[0, t] += 1


def splat_bin(footprints: Footprints, width: int, height: int, tile: int) -> Bins:
    """See `invgraphics.kernels.splat_bin`."""
    columns, lines = -(-width // tile), -(-height // tile)
    order, means, radii = depth_order(footprints), array(footprints.means2d), array(footprints.radii)
    places, starts = np.zeros((1, columns * lines), np.int64), np.empty(columns * lines + 1, np.int64)
    _squares(order, means, radii, tile, columns, lines, places, np.empty(0, np.int64))
    entries = np.empty(_running_totals(places, starts), np.int64)
    if len(entries):
        _squares(order, means, radii, tile, columns, lines, places, entries)
    return Bins(torch.from_numpy(entries), torch.from_numpy(starts), tile, columns, lines)
