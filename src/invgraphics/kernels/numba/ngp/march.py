"""Occupancy-grid marching of an Instant-NGP density with early ray termination, fused: march, encode, evaluate, composite.

Judged by `invgraphics.kernels.reference.ngp`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedNGP
from invgraphics.core.rays import Rays
from invgraphics.kernels import reference
from invgraphics.kernels.numba.hash.cells import BLOCK
from invgraphics.kernels.numba.hash.encode import levels_of
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.ngp.network import ACTIVATIONS, activate_density, encode, mlp, pack_network, radial_scale
from invgraphics.kernels.numba.ngp.queue import EDGE, current_interval, empty_queue, next_samples, queue_memory, terminate
from invgraphics.kernels.numba.rays.composite import interval_alpha
from invgraphics.kernels.numba.rays.march import MAX_INTERVALS, max_steps, pack_intervals, traversal_setup
from invgraphics.kernels.numba.runtime import array, inlined, parallel, prange, scratch, threads
from invgraphics.kernels.types import March, MarchSteps

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def append_interval(s, raw, scale, queue, far, settings, rows, counts):
    """Append the interval of slot ``s`` to its ray's row; terminate the ray below ``min_transmittance``.

    ``scale`` multiplies the density of ``raw``.
    """
    activation, bias, min_transmittance, _ = settings
    r = queue.ray_index[s]
    begin, end = current_interval(queue, s)
    queue.consumed[s] += 1
    rows[0, r, counts[r]], rows[1, r, counts[r]] = begin, end
    counts[r] += 1
    transmitted, _ = interval_alpha(activate_density(raw + bias, activation) * scale * (end - begin))
    queue.transmittance[s] *= transmitted
    if queue.transmittance[s] < min_transmittance:
        terminate(queue, s, far)


@parallel
def march_visible(rays, setup, table, levels, density_net, settings, queues, jobs, rows, counts):
    """Intervals of every ray up to its termination: starts and ends in ``rows`` (2, n, limit), ``counts`` of them (0 before).

    Arguments as in `ngp.render.render`; ``settings`` are density activation, bias, minimum transmittance, and
    `FusedNGP.contracted_density`.
    """
    sizes = density_net[1]
    for job in prange(jobs):
        entries, weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), sizes.max() * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        queue = empty_queue(queues, job)
        while next_samples((job, jobs, EDGE), rays, setup, queue, points):
            encode(table, levels, points, entries, weights, x)
            raw = mlp(density_net, x, ping, pong)
            for p in range(POINTS):
                if queue.slots[p] >= 0:
                    scale = settings[3] * radial_scale(points, p) if settings[3] > _ZERO else _ONE
                    append_interval(queue.slots[p], raw[p], scale, queue, rays[3], settings, rows, counts)


@torch.no_grad()
def ngp_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedNGP,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> March:
    """See `invgraphics.kernels.ngp_march`; cone steps and other than two features per entry are left to the reference."""
    unbounded = bounds.space == "contracted" and not steps.contracted
    if field.table.shape[1] != 2 or steps.cone > 0 or unbounded:
        return reference.ngp_march(rays, occupied, bounds, steps, field, start, min_transmittance)
    setup = traversal_setup(occupied, bounds, steps)
    # The last layer shrinks to the raw density: latent features for the colour are not needed.
    *hidden, (weight, bias) = field.density_net
    model = array(field.table).reshape(-1), levels_of(field.grid), pack_network((*hidden, (weight[:1], bias[:1])))
    settings = (
        ACTIVATIONS.index(field.density_activation),
        np.float32(field.density_bias),
        float(min_transmittance),
        np.float32(field.contracted_density),
    )
    limit = max_steps(rays, bounds, start, steps)
    batch, found = max(1, MAX_INTERVALS // limit), []
    for first in range(0, max(len(rays), 1), batch):
        batch_rays = tuple(array(x[first : first + batch]) for x in (rays.origins, rays.directions, start, rays.far))
        n = len(batch_rays[2])
        rows, counts = scratch("reached", 2 * n * limit).reshape(2, n, limit), np.zeros(n, np.int64)
        march_visible(batch_rays, setup, *model, settings, queue_memory(threads()), threads(), rows, counts)
        found.append(pack_intervals(rows[0], rows[1], counts, first))
    ray, t0, t1 = (torch.cat(columns) for columns in zip(*found, strict=True))
    return March(ray, t0, t1, torch.maximum(start, rays.far))
