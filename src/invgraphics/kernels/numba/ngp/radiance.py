"""Radiance of a signed distance's field, `POINTS` positions at a time: in one pass, without gradients."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.kernels import reference
from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.hash.cells import BLOCK
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.ngp.distance import coordinates, distances, gather, pack_levels, pack_sdf
from invgraphics.kernels.numba.ngp.network import encode, mlp, pack_network, sigmoid, softplus
from invgraphics.kernels.numba.runtime import LANES, array, index, inlined, job_start, parallel, prange, threads

_HARMONICS = index(16)


@inlined
def _write_harmonics(direction, start, last, bands_squared, scratch, inputs, first):
    """Write the harmonics of a batch's directions, from feature ``first`` on; lanes behind ``last`` repeat it."""
    for p in range(POINTS):
        i, lane = min(start + p, last), index(p)
        d = direction[i, 0], direction[i, 1], direction[i, 2]
        harmonics(d, scratch, lane // LANES * (_HARMONICS * LANES) + lane % LANES)
    for k in range(bands_squared):
        row = (first + index(k)) * POINTS
        for lane in range(LANES):
            left = index(k) * LANES + lane
            inputs[row + lane], inputs[row + LANES + lane] = scratch[left], scratch[_HARMONICS * LANES + left]


@parallel
def radiance_at(
    places, box, table, levels, octaves, net, sdf_settings, own_table, own_levels, colour_net, widest, settings, jobs, radiance
):
    """Radiance at all positions.

    Args:
        places: positions and directions, (n, 3) each.
        box: lowest corner, and 1 over the edges.
        table: features, flat.
        levels: see `levels_of`.
        octaves: number of octaves behind the coordinates, -1 for none.
        net: as that of `distance.values_at`, with geometry features behind the distance.
        sdf_settings: the ``settings`` of `distance.values_at`.
        own_table: features of the colour's own grid, flat.
        own_levels: its levels; none where colour has no grid.
        colour_net: layers and sizes as `pack_network` returns them.
        widest: largest number of inputs or outputs of any layer.
        settings: number of geometry features, number of harmonics, whether radiance is linear.
        jobs: number of jobs.
        radiance: output (n, 3).
    """
    lo, inverse = box
    position, direction = places
    features, bands_squared, linear = settings
    n, first = len(position), index(2 * len(levels[0])) * POINTS
    own = index(features) * POINTS
    directions_at = index(features + 2 * len(own_levels[0]))
    batches = (n + POINTS - 1) // POINTS
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        inputs, scratch = np.zeros(size, np.float32), np.zeros(_HARMONICS * POINTS, np.float32)
        own_inputs = inputs[own:]
        for batch in range(job_start(batches, jobs, job), job_start(batches, jobs, job + 1)):
            start = batch * POINTS
            gather(position, start, n - 1, lo, inverse, points)
            encode(table, levels, points, entries, weights, x)
            coordinates(points, x, first, sdf_settings, octaves)
            raw = distances(net, x, ping, pong, sdf_settings[0])
            for k in range(own):
                inputs[k] = raw[k + POINTS]
            encode(own_table, own_levels, points, entries, weights, own_inputs)
            _write_harmonics(direction, start, n - 1, bands_squared, scratch, inputs, directions_at)
            raw = mlp(colour_net, inputs, ping, pong)
            for p in range(min(POINTS, n - start)):
                for channel in range(3):
                    value = raw[index(channel) * POINTS + index(p)]
                    radiance[start + p, channel] = softplus(value) if linear else sigmoid(value)


@torch.no_grad()
def sdf_radiance(
    position: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], bounds: Bounds, field: FusedSDF
) -> Float[Tensor, "n 3"]:
    """See `invgraphics.kernels.sdf_radiance`; other than two features per entry are left to the reference."""
    colour = field.colour
    assert colour is not None
    if field.table.shape[1] != 2 or colour.table.shape[1] != 2:
        return reference.sdf_radiance(position, direction, bounds, field)
    radiance = torch.empty(len(position), 3)
    if len(position):
        box = array(bounds.lo), array(1 / (bounds.hi - bounds.lo))
        *geometry, widest, sdf_settings = pack_sdf(field, colour.geometry_net)
        colour_net = pack_network(colour.net)
        grids = *geometry, sdf_settings, array(colour.table).reshape(-1), pack_levels(colour.grid)
        settings = len(colour.geometry_net[-1][1]) - 1, colour.sh_bands**2, colour.colour_space == "linear"
        widest, places = max(widest, int(colour_net[1].max())), (array(position), array(direction))
        radiance_at(places, box, *grids, colour_net, widest, settings, threads(), radiance.numpy())
    return radiance
