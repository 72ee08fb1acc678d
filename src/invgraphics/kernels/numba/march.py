"""Walking along rays through an occupancy grid.

In plain IEEE arithmetic, operation for operation what `invgraphics.kernels.reference.march` does in float32, so that both keep
the same intervals; but an empty cell is looked at once, not at every step inside it.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.runtime import array, exact, exact_parallel, index, prange, scratch, share, threads
from invgraphics.kernels.types import March, MarchSteps

ROOM = 1 << 22
"""Most intervals that one batch of rays may keep, which bounds memory."""
MARGIN = np.float32(1e-2)
"""Share of a step by which a leap over an empty cell ends early, so that rounding never leaps into the next cell."""

_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))


@exact
def _to_unit(box, contracted, x, y, z):
    """`Bounds.to_unit`; ``box`` holds its centre and half edges."""
    x, y, z = (x - box[0]) / box[3], (y - box[1]) / box[4], (z - box[2]) / box[5]
    if contracted:
        squared = x * x + y * y + z * z
        if squared > _ONE:
            norm = np.sqrt(squared)
            scale = _TWO - _ONE / norm
            x, y, z = scale * (x / norm), scale * (y / norm), scale * (z / norm)
        x, y, z = x / _TWO, y / _TWO, z / _TWO
    return (x + _ONE) / _TWO, (y + _ONE) / _TWO, (z + _ONE) / _TWO


@exact
def _cell(unit, resolution):
    return min(max(np.int64(unit * np.float32(resolution)), 0), resolution - 1)


@exact
def _way_out(unit, cell, resolution, direction, half):
    """Distance along the ray to the cell's far wall on one axis; infinite where the ray runs parallel to it."""
    wall = np.float32(cell + 1 if direction > _ZERO else cell) / np.float32(resolution)
    return (wall - unit) * _TWO * half / direction if direction != _ZERO else np.float32(np.inf)


@exact
def _walk(origin, direction, t, far, occupied, box, contracted, step, cone, t0, t1):
    """Keep intervals of one ray until ``far`` or until ``t0`` is full; returns their number and where to go on."""
    resolution = occupied.shape[0]
    kept = 0
    free = -np.float32(np.inf)
    while t < far and kept < len(t0):
        length = max(cone * t, step)
        after = t + length
        if not after > t:
            # The step is lost to rounding, or not a number.
            return kept, far
        end = min(after, far)
        middle = (t + end) / _TWO
        if middle >= free:
            ux, uy, uz = _to_unit(
                box,
                contracted,
                origin[0] + middle * direction[0],
                origin[1] + middle * direction[1],
                origin[2] + middle * direction[2],
            )
            if ux >= _ZERO and uy >= _ZERO and uz >= _ZERO and ux <= _ONE and uy <= _ONE and uz <= _ONE:
                x, y, z = _cell(ux, resolution), _cell(uy, resolution), _cell(uz, resolution)
                if occupied[index(x), index(y), index(z)]:
                    t0[index(kept)], t1[index(kept)] = t, end
                    kept += 1
                elif not contracted:
                    out = min(
                        _way_out(ux, x, resolution, direction[0], box[3]), _way_out(uy, y, resolution, direction[1], box[4])
                    )
                    free = middle + min(out, _way_out(uz, z, resolution, direction[2], box[5])) - MARGIN * length
        t = end
    return kept, t


@exact_parallel
def walk(origins, directions, start, far, occupied, box, contracted, step, cone, jobs, t0, t1, counts, resume):
    """March all rays; ray i keeps ``counts[i]`` intervals, in row i of ``t0`` and ``t1``."""
    for job in prange(jobs):
        # Neighbouring rays cost alike: dealing them out in turn balances the jobs.
        for i in range(job, len(start), jobs):
            counts[i], resume[i] = _walk(
                origins[i], directions[i], start[i], far[i], occupied, box, contracted, step, cone, t0[i], t1[i]
            )


@exact_parallel
def gather(t0, t1, counts, ends, first_ray, jobs, ray, packed0, packed1):
    """Write each ray's intervals behind one another."""
    for job in prange(jobs):
        for i in range(share(len(counts), jobs, job), share(len(counts), jobs, job + 1)):
            begin = ends[i] - counts[i]
            for k in range(counts[i]):
                at = index(begin + k)
                ray[at], packed0[at], packed1[at] = first_ray + i, t0[i, k], t1[i, k]


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`."""
    box = array(torch.cat([bounds.centre, bounds.half]).float())
    resume = torch.empty(len(rays))
    parts = []
    batch = max(1, ROOM // max(steps.limit, 1))
    for first in range(0, len(rays), batch):
        some = slice(first, min(first + batch, len(rays)))
        n = some.stop - first
        t0 = scratch("march t0", n * steps.limit).reshape(n, steps.limit)
        t1 = scratch("march t1", n * steps.limit).reshape(n, steps.limit)
        counts = np.empty(n, np.int64)
        lines = (array(x[some]) for x in (rays.origins, rays.directions, start, rays.far))
        settings = (box, bounds.space == "contracted", np.float32(steps.step), np.float32(steps.cone), threads())
        walk(*lines, array(occupied), *settings, t0, t1, counts, resume[some].numpy())
        ends = np.cumsum(counts)
        kept = int(ends[-1])
        packed = (torch.empty(kept, dtype=torch.int64), torch.empty(kept), torch.empty(kept))
        gather(t0, t1, counts, ends, first, threads(), *(x.numpy() for x in packed))
        parts.append(packed)
    if not parts:
        return March(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0), resume)
    ray, t0, t1 = parts[0] if len(parts) == 1 else (torch.cat(columns) for columns in zip(*parts, strict=True))
    return March(ray, t0, t1, resume)
