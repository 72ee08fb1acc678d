"""Hash encoding and MLP inference for `POINTS` positions at a time, inlined into the fused kernels.

Arrays are flat and feature-major: `POINTS` values of the first feature, then of the second.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from invgraphics.kernels.numba.hash.cells import load_corners, locate_block, prefetch_entries
from invgraphics.kernels.numba.ngp.dense import POINTS, dense, pack_layer, padded
from invgraphics.kernels.numba.runtime import exp2, index, inlined, log2
from invgraphics.kernels.numba.simd.instructions import interpolate_pair
from invgraphics.kernels.types import EXP_LIMIT

ACTIVATIONS = ("exp", "softplus", "relu")
"""Density activations, by the index that is passed to kernels."""
_EXP, _SOFTPLUS = 0, 1

_ZERO, _ONE, _TWO, _FOUR = (np.float32(value) for value in (0.0, 1.0, 2.0, 4.0))
_LOG2E, _LN2 = np.float32(1 / np.log(2.0)), np.float32(np.log(2.0))
_MOST = np.float32(EXP_LIMIT)
_LARGEST = np.float32(80.0)
"""Beyond this exp(-x) is negligible beside 1; clamping keeps it within float32."""


@inlined
def softplus(x):
    """log(1 + exp(x))."""
    return max(x, _ZERO) + log2(_ONE + exp2(-abs(x) * _LOG2E)) * _LN2


@inlined
def sigmoid(x):
    """1 / (1 + exp(-x))."""
    return _ONE / (_ONE + exp2(min(-x, _LARGEST) * _LOG2E))


@inlined
def activate_density(raw, activation):
    """Density from a raw network output; ``activation`` is an index of `ACTIVATIONS`."""
    if activation == _EXP:
        return exp2(min(raw, _MOST) * _LOG2E)
    return softplus(raw) if activation == _SOFTPLUS else max(raw, _ZERO)


@inlined
def radial_scale(points, p):
    """`radial_scale_at` column ``p`` of positions."""
    return radial_scale_at(points[0, p], points[1, p], points[2, p])


@inlined
def radial_scale_at(ux, uy, uz):
    """`Bounds.radial_scale` at a position in the unit cube of a contracted space: (2 - |y|)², y after contraction."""
    x, y, z = _FOUR * ux - _TWO, _FOUR * uy - _TWO, _FOUR * uz - _TWO
    remaining = min(_TWO - np.sqrt(x * x + y * y + z * z), _ONE)
    return remaining * remaining


@inlined
def encode(table, levels, points, entries, weights, out):
    """Hash encoding of `POINTS` positions, feature-major; ``entries`` and ``weights`` are scratch for two levels.

    Software pipelining: a level's entries are prefetched before those of the previous level are read.
    """
    cells, offsets, masks = levels
    for number in range(len(cells) + 1):
        if number < len(cells):
            level, place = (cells[number], offsets[number], masks[number]), number % 2
            locate_block(points[0], points[1], points[2], (index(0), np.int64(POINTS)), level, entries[place], weights[place])
            prefetch_entries(table, entries[place], POINTS)
        if number > 0:
            column, place = index(2 * (number - 1)) * POINTS, (number - 1) % 2
            for point in range(POINTS):
                n = index(point)
                low, high = interpolate_pair(table, load_corners(entries[place], n), load_corners(weights[place], n))
                out[column + n], out[column + POINTS + n] = low, high


@inlined
def mlp(network, x, ping, pong):
    """Outputs of an MLP for `POINTS` inputs; layers write to ``ping`` and ``pong`` in turn."""
    layers, sizes = network
    at, last, source, target = index(0), len(sizes) - 1, x, ping
    for number in range(len(sizes)):
        size = index(sizes[number, 0]), index(sizes[number, 1])
        dense(layers, at, source, target, size, number < last)
        at += (size[0] + index(1)) * size[1]
        source, target = target, pong if number % 2 == 0 else ping
    return source


def pack_network(layers: tuple[tuple[Tensor, Tensor], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Layers of an MLP in the kernels' layout: packed weights, and per layer the numbers of inputs and padded outputs."""
    sizes = np.array([(weight.shape[1], padded(len(weight))) for weight, _ in layers], np.int64)
    return np.concatenate([pack_layer(weight, bias) for weight, bias in layers]), sizes
