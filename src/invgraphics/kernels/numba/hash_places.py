"""Many rays under way through a hash grid at once: what pictures in one pass and marches that stop have in common.

A job keeps `POINTS` rays in as many places and looks at the next occupied step of all of them. A ray that has met something
opaque, or has left, makes room for another one at once.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from invgraphics.kernels.numba.dense import POINTS, dense, packed_layer, padded
from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.hash_cells import at_vertices, locate
from invgraphics.kernels.numba.instructions import blend_pair
from invgraphics.kernels.numba.march import to_unit, walk_ray
from invgraphics.kernels.numba.runtime import LANES, exp2, index, inlined, log2
from invgraphics.kernels.types import EXP_LIMIT

AHEAD = 8
"""Occupied steps of a ray that are found at once."""
DEAL = 64
"""Neighbouring rays that a job takes at once."""
ACTIVATIONS = ("exp", "softplus", "relu")
"""Of densities, by the numbers that kernels know them by."""
_EXP, _SOFTPLUS = 0, 1

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_LOG2E, _LN2 = np.float32(1 / np.log(2.0)), np.float32(np.log(2.0))
_MOST = np.float32(EXP_LIMIT)
_LARGEST = np.float32(80.0)
"""Beyond this exp(-x) is nothing beside 1, and stays within float32."""


@inlined
def softplus(x):
    """log(1 + exp(x))."""
    return max(x, _ZERO) + log2(_ONE + exp2(-abs(x) * _LOG2E)) * _LN2


@inlined
def sigmoid(x):
    """1 / (1 + exp(-x))."""
    return _ONE / (_ONE + exp2(min(-x, _LARGEST) * _LOG2E))


@inlined
def density_of(raw, activation):
    """The density that a network's output stands for; ``activation`` is one of `ACTIVATIONS`, by number."""
    if activation == _EXP:
        return exp2(min(raw, _MOST) * _LOG2E)
    return softplus(raw) if activation == _SOFTPLUS else max(raw, _ZERO)


@inlined
def encode(table, levels, points, entries, weights, out):
    """Features of `POINTS` positions, feature after feature."""
    cells, offsets, masks = levels
    for number in range(len(cells)):
        level = cells[number], offsets[number], masks[number]
        locate(points[0], points[1], points[2], (index(0), np.int64(POINTS)), level, entries, weights)
        column = index(2 * number) * POINTS
        for point in range(POINTS):
            n = index(point)
            low, high = blend_pair(table, at_vertices(entries, n), at_vertices(weights, n))
            out[column + n], out[column + POINTS + n] = low, high


@inlined
def outputs_of(network, x, odd, even):
    """The outputs of `POINTS` inputs; layers write to ``odd`` and ``even`` in turn."""
    layers, sizes = network
    at, last, source, target = index(0), len(sizes) - 1, x, odd
    for number in range(len(sizes)):
        size = index(sizes[number, 0]), index(sizes[number, 1])
        dense(layers, at, source, target, size, number < last)
        at += (size[0] + index(1)) * size[1]
        source, target = target, even if number % 2 == 0 else odd
    return source


@inlined
def places():
    """`POINTS` places without a ray.

    Their rays; begin and end of the steps found, how many there are and have been looked at; after how many of all steps and
    where the ray goes on; what is left of its light, and what was left out of its picture; harmonics of its direction.
    """
    which, steps = np.full(POINTS, -1, np.int64), np.zeros(POINTS, np.int64)
    kept, done = np.zeros(POINTS, np.int64), np.zeros(POINTS, np.int64)
    t0, t1 = np.zeros((POINTS, AHEAD), np.float32), np.zeros((POINTS, AHEAD), np.float32)
    resume, missed = np.zeros(POINTS, np.float32), np.zeros(POINTS, np.float32)
    light, views = np.zeros(POINTS, np.float64), np.zeros(16 * POINTS, np.float32)
    return which, t0, t1, kept, done, steps, resume, light, missed, views


@inlined
def _ray_of(taken, job, jobs):
    """The ray that a job takes after so many others."""
    return (taken // DEAL * jobs + job) * DEAL + taken % DEAL


@inlined
def view_of(s):
    """Where the harmonics of place ``s`` begin; they follow one another after `LANES` numbers."""
    return (index(s) // LANES) * index(16) * LANES + index(s) % LANES


@inlined
def _advance(s, taken, deal, lines, space, way):
    """Find the next occupied steps for place ``s``, of its ray or of further ones; returns the rays taken by then."""
    origins, directions, start, far = lines
    occupied, gaps, shift, box, contracted, step, cone = space
    which, t0, t1, kept, done, steps, resume, light, missed, views = way
    job, jobs = deal
    while done[s] == kept[s]:
        r = which[s]
        if r >= 0 and resume[s] < far[r]:
            # The lattice is counted from the ray's start, so that these are the very steps of an ordinary march.
            kept[s], steps[s], resume[s] = walk_ray(
                origins[r], directions[r], start[r], steps[s], resume[s], far[r], occupied, gaps, shift, box, contracted, step,
                cone, t0[s], t1[s],
            )  # fmt: skip
            done[s] = 0
            direction = directions[r, 0], directions[r, 1], directions[r, 2]
            harmonics(direction, views, view_of(s))
        else:
            r = _ray_of(taken, job, jobs)
            if r >= len(far):
                which[s] = -1
                break
            taken += 1
            which[s], steps[s], resume[s], light[s], missed[s] = r, 0, start[r], 1.0, _ZERO
    return taken


@inlined
def _position(s, way, lines, space, points):
    """Where the step of place ``s`` has its middle, in the unit cube."""
    origins, directions, box, contracted = lines[0], lines[1], space[3], space[4]
    which, t0, t1, _, done, _, _, _, _, _ = way
    r, t = which[s], (t0[s, done[s]] + t1[s, done[s]]) * _HALF
    x, y, z = (
        origins[r, 0] + t * directions[r, 0],
        origins[r, 1] + t * directions[r, 1],
        origins[r, 2] + t * directions[r, 2],
    )
    points[0, s], points[1, s], points[2, s] = to_unit(box, contracted, x, y, z)


@inlined
def fill(taken, deal, lines, space, way, points):
    """Give every place its ray's next occupied step; returns the rays taken by then, and whether any has one."""
    busy = False
    for s in range(POINTS):
        taken = _advance(s, taken, deal, lines, space, way)
        if way[0][s] >= 0:
            busy = True
            _position(s, way, lines, space, points)
    return taken, busy


def packed_network(layers: tuple[tuple[Tensor, Tensor], ...]) -> tuple[np.ndarray, np.ndarray]:
    """A network as kernels read it: its layers, and their inputs and padded outputs."""
    sizes = np.array([(weight.shape[1], padded(len(weight))) for weight, _ in layers], np.int64)
    return np.concatenate([packed_layer(weight, bias) for weight, bias in layers]), sizes
