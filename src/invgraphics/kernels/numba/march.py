"""Walking along rays through an occupancy grid.

In plain IEEE arithmetic, operation for operation what `invgraphics.kernels.reference.march` does in float32, so that both keep
the same intervals; but an empty cell, or an empty block of cells, is looked at once, not at every step inside it.
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

BLOCK = 8
"""Cells along the edge of a block."""

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
def _way_out(unit, first, cells, resolution, direction, half):
    """Distance along the ray to the far wall, on one axis, of ``cells`` cells from ``first`` on; infinite where parallel."""
    wall = np.float32(first + cells if direction > _ZERO else first) / np.float32(resolution)
    return (wall - unit) * _TWO * half / direction if direction != _ZERO else np.float32(np.inf)


@exact
def _walk(origin, direction, first, far, occupied, blocks, box, contracted, step, cone, t0, t1):
    """Keep intervals of one ray until ``far`` or until ``t0`` is full; returns their number and where to go on."""
    resolution = occupied.shape[0]
    t = first
    kept = taken = 0
    free = -np.float32(np.inf)
    while t < far and kept < len(t0):
        # Without a cone the lattice is counted from the first step, so that leaping over steps changes no bit of the rest.
        after = first + np.float32(taken + 1) * step if cone == _ZERO else t + max(cone * t, step)
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
                    cells = 1
                    if not blocks[index(x // BLOCK), index(y // BLOCK), index(z // BLOCK)]:
                        cells = BLOCK
                        x, y, z = x // BLOCK * BLOCK, y // BLOCK * BLOCK, z // BLOCK * BLOCK
                    out = min(
                        _way_out(ux, x, cells, resolution, direction[0], box[3]),
                        _way_out(uy, y, cells, resolution, direction[1], box[4]),
                    )
                    out = min(out, _way_out(uz, z, cells, resolution, direction[2], box[5]))
                    free = min(middle + out - MARGIN * (end - t), far)
                    if cone == _ZERO:
                        # To a step or two before the wall; the comparison with ``free`` settles the rest.
                        leap = np.int64((free - first) / step) - 2
                        if leap > taken + 1:
                            taken = leap - 1
                            end = first + np.float32(leap) * step
        t = end
        taken += 1
    return kept, t


@exact_parallel
def summarise(occupied, blocks):
    """Mark the blocks that have an occupied cell."""
    resolution = occupied.shape[0]
    for i in prange(blocks.shape[0]):
        blocks[i] = False
        for x in range(i * BLOCK, min((i + 1) * BLOCK, resolution)):
            for y in range(resolution):
                for z in range(resolution):
                    if occupied[x, y, z]:
                        blocks[i, y // BLOCK, z // BLOCK] = True


@exact_parallel
def walk(origins, directions, start, far, occupied, blocks, box, contracted, step, cone, jobs, t0, t1, counts, resume):
    """March all rays; ray i keeps ``counts[i]`` intervals, in row i of ``t0`` and ``t1``."""
    for job in prange(jobs):
        # Neighbouring rays cost alike: dealing them out in turn balances the jobs.
        for i in range(job, len(start), jobs):
            counts[i], resume[i] = _walk(
                origins[i], directions[i], start[i], far[i], occupied, blocks, box, contracted, step, cone, t0[i], t1[i]
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
    cells = array(occupied)
    blocks = np.empty(3 * (-(-occupied.shape[0] // BLOCK),), np.bool_)
    summarise(cells, blocks)
    resume = torch.empty(len(rays))
    parts = []
    limit = _most(rays, start, steps)
    batch = max(1, ROOM // max(limit, 1))
    for first in range(0, len(rays), batch):
        some = slice(first, min(first + batch, len(rays)))
        n = some.stop - first
        t0 = scratch("march t0", n * limit).reshape(n, limit)
        t1 = scratch("march t1", n * limit).reshape(n, limit)
        counts = np.empty(n, np.int64)
        lines = (array(x[some]) for x in (rays.origins, rays.directions, start, rays.far))
        settings = (box, bounds.space == "contracted", np.float32(steps.step), np.float32(steps.cone), threads())
        walk(*lines, cells, blocks, *settings, t0, t1, counts, resume[some].numpy())
        ends = np.cumsum(counts)
        kept = int(ends[-1])
        packed = (torch.empty(kept, dtype=torch.int64), torch.empty(kept), torch.empty(kept))
        gather(t0, t1, counts, ends, first, threads(), *(x.numpy() for x in packed))
        parts.append(packed)
    if not parts:
        return March(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0), resume)
    ray, t0, t1 = parts[0] if len(parts) == 1 else (torch.cat(columns) for columns in zip(*parts, strict=True))
    return March(ray, t0, t1, resume)


def _most(rays: Rays, start: Float[Tensor, " n"], steps: MarchSteps) -> int:
    """Most intervals that any ray can keep: steps are never shorter than ``steps.step``."""
    longest = float((rays.far - start).nan_to_num(0.0).max()) if len(rays) else 0.0
    return min(steps.limit, int(min(max(longest, 0.0) / steps.step, steps.limit)) + 2)
