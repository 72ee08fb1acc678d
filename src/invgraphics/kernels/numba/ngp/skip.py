"""Empty-space skipping along rays by a grid of signed distances."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.runtime import array, inlined, job_start, parallel, prange, threads

_HALF, _ONE = np.float32(0.5), np.float32(1)


@inlined
def _cell(place, count):
    """Cell of a coordinate in units of cells; of the box's boundary outside."""
    return max(min(np.int32(place), np.int32(count - 1)), np.int32(0))


@inlined
def _free(x, y, z, distances, edges):
    """Least distance from the surface at a place in units of cells, from that of its cell's centre."""
    i, j, k = _cell(x, distances.shape[0]), _cell(y, distances.shape[1]), _cell(z, distances.shape[2])
    a, b, c = x - np.float32(i) - _HALF, y - np.float32(j) - _HALF, z - np.float32(k) - _HALF
    a, b, c = a * edges[0], b * edges[1], c * edges[2]
    return distances[i, j, k] - np.sqrt(a * a + b * b + c * c)


@parallel
def skip(rays, lo, edges, distances, settings, jobs, starts):
    """Distances up to which rays are free of surfaces.

    Args:
        rays: origins, directions, starts and ends.
        lo: lowest corner of the box.
        edges: of a cell.
        distances: (rx, ry, rz), signed distances of the cells' centres.
        settings: margin, shortest step, factor of the distances.
        jobs: number of jobs.
        starts: output (n,).
    """
    origins, directions, near, far = rays
    (margin, least, factor), inverse = settings, _ONE / edges
    for job in prange(jobs):
        for r in range(job_start(len(near), jobs, job), job_start(len(near), jobs, job + 1)):
            t, end = near[r], far[r]
            while t < end:
                x = (origins[r, 0] + t * directions[r, 0] - lo[0]) * inverse[0]
                y = (origins[r, 1] + t * directions[r, 1] - lo[1]) * inverse[1]
                z = (origins[r, 2] + t * directions[r, 2] - lo[2]) * inverse[2]
                free = factor * _free(x, y, z, distances, edges) - margin
                moved = t + free
                if not (free > least and moved > t):
                    break
                t = moved
            starts[r] = min(t, end)


@torch.no_grad()
def sdf_skip(
    rays: Rays, bounds: Bounds, distances: Float[Tensor, "rx ry rz"], margin: float, least: float, factor: float
) -> Float[Tensor, " n"]:
    """See `invgraphics.kernels.sdf_skip`."""
    edges = (bounds.hi - bounds.lo) / torch.tensor(distances.shape)
    batch = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    starts = torch.empty(len(rays))
    settings = np.float32(margin), np.float32(least), np.float32(factor)
    skip(batch, array(bounds.lo), array(edges), array(distances), settings, threads(), starts.numpy())
    return starts
