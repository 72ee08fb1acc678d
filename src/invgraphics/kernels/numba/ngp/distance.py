"""Signed distances of a network over a hash grid or octaves, `POINTS` positions at a time: in one pass, without gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF, HashGrid
from invgraphics.kernels import reference
from invgraphics.kernels.numba.hash.cells import BLOCK
from invgraphics.kernels.numba.hash.encode import levels_of
from invgraphics.kernels.numba.ngp.dense import POINTS, dense
from invgraphics.kernels.numba.ngp.network import encode, pack_network, softplus
from invgraphics.kernels.numba.runtime import array, index, inlined, job_start, parallel, prange, threads

_NO_LEVELS = np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros(0, np.uint64)
_ONE, _TWO, _PI = np.float32(1), np.float32(2), np.float32(np.pi)
_THREE = index(3) * POINTS


@inlined
def distances(net, x, ping, pong, sharpness):
    """Outputs of a softplus network for `POINTS` inputs; layers write to ``ping`` and ``pong`` in turn."""
    layers, sizes = net
    at, last, source, target = index(0), len(sizes) - 1, x, ping
    for number in range(len(sizes)):
        size = index(sizes[number, 0]), index(sizes[number, 1])
        dense(layers, at, source, target, size, False)
        if number < last:
            for k in range(index(size[1] * POINTS)):
                target[k] = softplus(sharpness * target[k]) / sharpness
        at += (size[0] + index(1)) * size[1]
        source, target = target, pong if number % 2 == 0 else ping
    return source


@inlined
def coordinates(points, x, first, settings, octaves):
    """Write scaled coordinates at ``first``; unless ``octaves`` is negative, behind them x, its sines and its cosines."""
    for axis in range(3):
        for p in range(POINTS):
            u, at = _TWO * points[axis, p] - _ONE, first + index(axis) * POINTS + index(p)
            x[at] = u * settings[2 + axis]
            if octaves >= 0:
                x[at + _THREE] = u
                sine, cosine = np.sin(_PI * u), np.cos(_PI * u)
                for octave in range(octaves):
                    row = at + _THREE * index(2 + octave)
                    x[row], x[row + _THREE * index(octaves)] = sine, cosine
                    sine, cosine = _TWO * sine * cosine, cosine * cosine - sine * sine


def pack_levels(grid: HashGrid | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grid's `levels_of`, empty without one."""
    return _NO_LEVELS if grid is None else levels_of(grid)


def pack_sdf(field: FusedSDF, net: tuple[tuple[Tensor, Tensor], ...] | None = None) -> tuple[Any, ...]:
    """The arguments ``table`` to ``settings`` of `values_at`, of another network over the same inputs where one is given."""
    (weight, bias), *others = net or field.net
    levels, octaves = pack_levels(field.grid), field.octaves
    if field.grid is not None:
        octaves = -1
        weight = torch.cat([weight[:, 3:], weight[:, :3]], dim=1)
    packed = pack_network(((weight, bias), *others))
    settings = np.array([field.sharpness, field.scale, *field.coordinate_scale.tolist()], np.float32)
    return array(field.table).reshape(-1), levels, octaves, packed, int(packed[1].max()), settings


@inlined
def gather(position, start, last, lo, inverse, points):
    """Coordinates in the unit box of a batch's positions, (3, `POINTS`); lanes behind ``last`` repeat it."""
    for p in range(POINTS):
        i = min(start + p, last)
        for axis in range(3):
            points[axis, p] = (position[i, axis] - lo[axis]) * inverse[axis]


@parallel
def values_at(position, box, table, levels, octaves, net, widest, settings, jobs, values):
    """Signed distances of all positions.

    Args:
        position: (n, 3).
        box: lowest corner, and 1 over the edges.
        table: features, flat.
        levels: see `levels_of`.
        octaves: number of octaves behind the coordinates, -1 for none.
        net: layers and sizes as `pack_network` returns them; its inputs are the features, then what `coordinates` writes.
        widest: largest number of inputs or outputs of any layer.
        settings: sharpness, scale of the distance, scales of the coordinates.
        jobs: number of jobs.
        values: output (n,).
    """
    lo, inverse = box
    n, first = len(position), index(2 * len(levels[0])) * POINTS
    batches = (n + POINTS - 1) // POINTS
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        for batch in range(job_start(batches, jobs, job), job_start(batches, jobs, job + 1)):
            start = batch * POINTS
            gather(position, start, n - 1, lo, inverse, points)
            encode(table, levels, points, entries, weights, x)
            coordinates(points, x, first, settings, octaves)
            raw = distances(net, x, ping, pong, settings[0])
            for p in range(min(POINTS, n - start)):
                values[start + p] = raw[p] * settings[1]


@torch.no_grad()
def sdf_values(position: Float[Tensor, "n 3"], bounds: Bounds, field: FusedSDF) -> Float[Tensor, " n"]:
    """See `invgraphics.kernels.sdf_values`; other than two features per entry are left to the reference."""
    if field.table.shape[1] != 2:
        return reference.sdf_values(position, bounds, field)
    values = torch.empty(len(position))
    if len(position):
        box = array(bounds.lo), array(1 / (bounds.hi - bounds.lo))
        values_at(array(position), box, *pack_sdf(field), threads(), values.numpy())
    return values
