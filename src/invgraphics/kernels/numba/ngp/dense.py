"""Dense layer of a small MLP for 32 points at a time: accumulators of four outputs stay in registers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.numba.runtime import LANES, array, index, inlined
from invgraphics.kernels.numba.simd.lanes import broadcast, load, store

POINTS = LANES + LANES
"""Batch size: arrays are feature-major, ``POINTS`` values per feature."""
TILE = 4
"""Outputs accumulated together; their number is padded to a multiple of it."""

_FOUR, _1, _2, _3 = index(TILE), index(1), index(2), index(3)
_ZERO = np.float32(0.0)


def padded(outputs: int) -> int:
    """Number of outputs of a layer, padded for `dense`."""
    return -(-outputs // TILE) * TILE


def pack_layer(weight: Float[Tensor, "outs ins"], bias: Float[Tensor, " outs"]) -> np.ndarray:
    """Weights and biases in the layout of `dense`: per `TILE` outputs the biases, then the weights input by input."""
    outputs, inputs = weight.shape
    rows = np.zeros((padded(outputs), 1 + inputs), np.float32)
    rows[:outputs, 0], rows[:outputs, 1:] = array(bias), array(weight)
    return rows.reshape(-1, TILE, 1 + inputs).transpose(0, 2, 1).reshape(-1)


@inlined
def _four(layer, at):
    return layer[at], layer[at + _1], layer[at + _2], layer[at + _3]


@inlined
def _put(y, row, left, right, rectified):
    at = row * POINTS
    store(y, at, max(left, _ZERO) if rectified else left)
    store(y, at + LANES, max(right, _ZERO) if rectified else right)


@inlined
def dense(layer, at, x, y, sizes, rectified):
    """Apply a layer to `POINTS` points: ``y = W x + b``, or 0 where that is negative and ``rectified``.

    ``layer`` is a flat array in which the layer begins at ``at`` (see `pack_layer`), ``x`` and ``y`` are flat arrays,
    ``sizes`` the numbers of inputs and of padded outputs (uint64). All numbers are float32.
    """
    inputs, outputs = sizes
    for block in range(outputs // _FOUR):
        first = index(block) * _FOUR
        place = at + first * (inputs + _1)
        p, q, r, s = _four(layer, place)
        p0, q0, r0, s0 = broadcast(p), broadcast(q), broadcast(r), broadcast(s)
        p1, q1, r1, s1 = p0, q0, r0, s0
        for k in range(inputs):
            place += _FOUR
            left, right = load(x, index(k) * POINTS), load(x, index(k) * POINTS + LANES)
            p, q, r, s = _four(layer, place)
            p0, q0, r0, s0 = p0 + p * left, q0 + q * left, r0 + r * left, s0 + s * left
            p1, q1, r1, s1 = p1 + p * right, q1 + q * right, r1 + r * right, s1 + s * right
        _put(y, first, p0, p1, rectified)
        _put(y, first + _1, q0, q1, rectified)
        _put(y, first + _2, r0, r1, rectified)
        _put(y, first + _3, s0, s1, rectified)
