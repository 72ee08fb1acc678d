"""Occupancy-grid marching of a density over lattices with early ray termination, as `ngp.march`.

Judged by `invgraphics.kernels.reference.fused`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.fused import FusedLattice
from invgraphics.core.rays import Rays
from invgraphics.kernels import reference
from invgraphics.kernels.numba.fused.heads import (
    apply_network,
    contiguous,
    encode_points,
    pack_encoding,
    pack_layers,
    points_scratch,
    points_words,
)
from invgraphics.kernels.numba.fused.render import crop_points, density_scale, pack_crop
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.ngp.march import append_interval
from invgraphics.kernels.numba.ngp.network import ACTIVATIONS
from invgraphics.kernels.numba.ngp.queue import EDGE, empty_queue, next_samples, queue_memory
from invgraphics.kernels.numba.rays.march import MAX_INTERVALS, max_steps, pack_intervals, traversal_setup
from invgraphics.kernels.numba.runtime import GROUP, array, index, parallel, prange, scratch, threads
from invgraphics.kernels.types import March, MarchSteps


@parallel
def march_visible(rays, setup, geometry, network, smooth, crop, sizes, memory, settings, queues, jobs, rows, counts):
    """Intervals of every ray up to its termination: starts and ends in ``rows`` (2, n, limit), ``counts`` of them (0 before).

    Arguments as in `render.render`, but for ``settings``: those of `ngp.march.append_interval`, then scale and
    contracted scale of the density.
    """
    for job in prange(jobs):
        points, size = np.zeros((3, POINTS), np.float32), index(sizes[0]) * POINTS
        x, ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        corners, queue = points_scratch(memory + 4 * np.int64(job) * sizes[1], geometry), empty_queue(queues, job)
        while next_samples((job, jobs, EDGE), rays, setup, queue, points):
            crop_points(points, crop)
            encode_points(points, geometry, corners, x)
            raw = apply_network(network, smooth, x, ping, pong)
            for p in range(POINTS):
                if queue.slots[p] >= 0:
                    scale = density_scale(settings, points, crop, p)
                    append_interval(queue.slots[p], raw[p], scale, queue, rays[3], settings[:4], rows, counts)


@torch.no_grad()
def lattice_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedLattice,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> March:
    """See `invgraphics.kernels.lattice_march`; cone steps are left to the reference."""
    unbounded = bounds.space == "contracted" and not steps.contracted
    if steps.cone > 0 or unbounded:
        return reference.lattice_march(rays, occupied, bounds, steps, field, start, min_transmittance)
    setup, density = traversal_setup(occupied, bounds, steps), field.density
    encoding = contiguous(field.geometry)  # holds what the kernel has addresses of
    # The last layer shrinks to the raw density: what colour gets is not needed.
    layers = field.geometry_net[:-1] + tuple((weight[:1], bias[:1]) for weight, bias in field.geometry_net[-1:])
    geometry, network = pack_encoding(encoding), pack_layers(layers)
    sizes, jobs = (max(geometry[1], *network[1].flatten(), GROUP), points_words(geometry)), threads()
    memory = scratch("lattice.points", jobs * sizes[1]).ctypes.data
    appending = ACTIVATIONS.index(density.activation), np.float32(density.bias), float(min_transmittance), np.float32(0)
    settings = *appending, np.float32(density.scale), np.float32(density.contracted)
    limit = max_steps(rays, bounds, start, steps)
    batch, found = max(1, MAX_INTERVALS // limit), []
    for first in range(0, max(len(rays), 1), batch):
        batch_rays = tuple(array(x[first : first + batch]) for x in (rays.origins, rays.directions, start, rays.far))
        n = len(batch_rays[2])
        rows, counts = scratch("reached", 2 * n * limit).reshape(2, n, limit), np.zeros(n, np.int64)
        model = geometry, network, field.hidden == "softplus", pack_crop(field), sizes, memory, settings
        march_visible(batch_rays, setup, *model, queue_memory(jobs), jobs, rows, counts)
        found.append(pack_intervals(rows[0], rows[1], counts, first))
    ray, t0, t1 = (torch.cat(columns) for columns in zip(*found, strict=True))
    return March(ray, t0, t1, torch.maximum(start, rays.far))
