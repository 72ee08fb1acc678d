"""Edges of a ray's quadrature intervals (`kernels.reference.gaussian_quadrature.place_nodes`), with a radix sort."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import GROUP, exp2, index, inlined
from invgraphics.kernels.numba.simd.lanes import exp2_of, load, store, where
from invgraphics.kernels.numba.simd.partial import unowned
from invgraphics.kernels.reference.gaussian_quadrature import EDGES, MAX_OPTICAL_DEPTH, phi

_EDGES = np.array(EDGES, np.float32)
COUNT = len(EDGES)
"""Edges of one Gaussian's staircase."""


def _rises() -> np.ndarray:
    """Steps of the staircase of a unit Gaussian's mean density at its `EDGES`."""
    import torch

    z = torch.tensor(EDGES, dtype=torch.float64)
    heights = (phi(z).diff() / z.diff()).numpy()
    return np.diff(heights, prepend=0.0, append=0.0).astype(np.float32)


_RISES = _rises()
_LOG2E = np.float32(1 / np.log(2.0))
_HALF, _ONE, _SIXTH, _THIN = np.float32(0.5), np.float32(1.0), np.float32(1 / 6), np.float32(0.02)
_MOST = np.float32(MAX_OPTICAL_DEPTH)
_TINY, _EPS = np.float32(np.finfo(np.float32).tiny), np.float32(np.finfo(np.float32).eps)
_BITS, _BUCKETS, PASSES = np.uint32(8), 256, 3
_LAST_KEY = np.float32(2**24 - 1)
"""Edges are sorted, and placed, in steps of this part of a ray's interval: float32 has no more digits. With 16 bits, steps
would be wider than thin Gaussians in front of a distant one, which would then mix instead of hiding each other."""
_DEEPEST = np.float32(18.0)
"""Optical depth of the staircase behind which Gaussians are not looked at: float32 has no alpha between it and 1."""


@inlined
def _sort(keys, rises, keys_swap, rises_swap, n, counts):
    """Sort 24-bit keys with what belongs to them, of which ``counts`` holds the histograms; they end in the second arrays."""
    for p in range(PASSES):
        shift = np.uint32(_BITS * np.uint32(p))
        total = np.int32(0)
        for bucket in range(_BUCKETS):
            count = counts[p, bucket]
            counts[p, bucket] = total
            total += count
        for i in range(n):
            bucket = (keys[i] >> shift) & np.uint32(255)
            place = counts[p, bucket]
            counts[p, bucket] = place + np.int32(1)
            keys_swap[place], rises_swap[place] = keys[i], rises[i]
        keys, keys_swap = keys_swap, keys
        rises, rises_swap = rises_swap, rises


@inlined
def place_nodes(t, sigma, depth, begin, end, near, far, steps, nodes, scratch, counts):
    """Fill ``nodes`` with edges of ``steps`` intervals from near to far, for the Gaussians ``begin`` to ``end - 1`` of a ray.

    Further nodes are far. ``scratch`` holds six rows, whole registers, of at least `COUNT` entries per Gaussian: keys, rises,
    both once more, and two sums. Returns the distance behind which no light comes from, infinite where the ray is not blocked.
    """
    n = 0
    counts[:] = 0
    scale = _LAST_KEY / max(far - near, _TINY)
    step = max(far - near, _TINY) / _LAST_KEY
    keys, swap, flat, width = scratch[0].view(np.uint32), scratch[2].view(np.uint32), unowned(scratch), scratch.shape[1]
    for i in range(begin, end):
        height = depth[i] / sigma[i]
        for e in range(COUNT):
            at = min(max(t[i] + sigma[i] * _EDGES[e], near), far)
            key = np.uint32(min((at - near) * scale + np.float32(0.5), _LAST_KEY))
            keys[n], scratch[1, n] = key, height * _RISES[e]
            counts[0, key & np.uint32(255)] += 1
            counts[1, (key >> _BITS) & np.uint32(255)] += 1
            counts[2, key >> (_BITS + _BITS)] += 1
            n += 1
    _sort(keys, scratch[1], swap, scratch[3], n, counts)
    place, rises, reached, grown = scratch[0], scratch[3], scratch[4], scratch[5]
    for i in range(n):
        place[i] = np.float32(swap[i]) * step
    density, total = 0.0, 0.0
    reached[0] = np.float32(0.0)
    stop = np.float32(np.inf)
    for i in range(n - 1):
        # In float64, because the density of thin Gaussians is large and must vanish behind them.
        density += np.float64(rises[i])
        total += max(density, 0.0) * np.float64(place[i + 1] - place[i])
        reached[i + 1] = np.float32(total)
        if reached[i + 1] >= _DEEPEST and place[i + 1] < stop:
            stop = place[i + 1]
    last = max(np.float32(total), _TINY)
    whole = np.float32(1.0) / _one_minus_exp(last)
    deepest = np.float32(1.0) / min(last, _MOST)
    for i in range(0, n, GROUP):
        depths = load(flat, index(4 * width + i))
        thin = depths * (_ONE - depths * (_HALF - depths * _SIXTH))
        alpha = where(depths < _THIN, thin, _ONE - exp2_of(-_LOG2E * depths))
        store(flat, index(5 * width + i), alpha * whole + min(depths, _MOST) * deepest)
    nodes[0], nodes[steps:] = near, far
    after = 1
    for s in range(1, steps):
        wanted = np.float32(2.0) * np.float32(s) / np.float32(steps)
        while after < n - 1 and grown[after] < wanted:
            after += 1
        low, high = grown[after - 1], grown[after]
        part = min(max((wanted - low) / max(high - low, _EPS), np.float32(0.0)), np.float32(1.0))
        nodes[s] = near + place[after - 1] + part * (place[after] - place[after - 1])
    return near + stop


@inlined
def _one_minus_exp(x):
    """1 - exp(-x) for x >= 0; a series where the difference would cancel."""
    if x < _THIN:
        return x * (_ONE - x * (_HALF - x * _SIXTH))
    return _ONE - exp2(-x * _LOG2E)
