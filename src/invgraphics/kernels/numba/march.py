"""Walking along rays through an occupancy grid.

In plain IEEE arithmetic, operation for operation what `invgraphics.kernels.reference.march` does in float32, so that both keep
the same intervals; but empty space is leapt over: a cell at a time near what is occupied, many blocks of cells farther away.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.runtime import array, exact, exact_parallel, index, prange, scratch, serial, share, threads
from invgraphics.kernels.types import March, MarchSteps

ROOM = 1 << 22
"""Most intervals that one batch of rays may keep, which bounds memory."""
MARGIN = np.float32(1e-2)
"""Share of a step by which a leap over an empty cell ends early, so that rounding never leaps into the next cell."""

ROUNDING = np.float32(1e-6)
"""Several times the relative rounding error of a float32."""
NEARLY_HALF = np.float32(0.49)
"""Steps from a step's middle to its end, less what a leap may be too short by."""

BLOCKS = 32
"""Most blocks along the grid's edge; their edges are powers of two, ``1 << shift`` cells long."""

_PARALLEL = np.float32(1e-20)
"""Directions with less than this along an axis never reach a wall on it."""
_ZERO, _ONE, _TWO = (np.float32(value) for value in (0.0, 1.0, 2.0))


@exact
def to_unit(box, contracted, x, y, z):
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
def _way_out(unit, first, cells, cell, pace):
    """Distance along the ray to the far wall, on one axis, of ``cells`` cells from ``first`` on.

    ``cell`` is a cell's edge in the unit cube, ``pace`` the distance along the ray per unit on this axis.
    """
    return (np.float32(first + cells if pace > _ZERO else first) * cell - unit) * pace


@exact
def _aligned(cell, shift, gap):
    """First cell, on one axis, of the blocks less than ``gap`` away from a cell's own."""
    return ((cell >> shift) - gap + 1) << shift


@exact
def _pace(direction, half):
    """Distance along the ray per unit on one axis of the unit cube; next to endless where parallel."""
    return (
        _TWO * half / direction if abs(direction) > _PARALLEL else np.float32(np.copysign(_TWO * half / _PARALLEL, direction))
    )


@exact
def walk_ray(origin, direction, first, taken, t, far, occupied, gaps, shift, box, contracted, step, cone, t0, t1):
    """Keep intervals of one ray until ``far`` or until ``t0`` is full.

    The ray began at ``first`` and is at ``t``, after ``taken`` steps. Returns how many intervals were kept, and both of these.
    """
    resolution = occupied.shape[0]
    cell, per_step = _ONE / np.float32(resolution), _ONE / step
    pace_x, pace_y, pace_z = _pace(direction[0], box[3]), _pace(direction[1], box[4]), _pace(direction[2], box[5])
    kept = 0
    free = -np.float32(np.inf)
    while t < far and kept < len(t0):
        # Without a cone the lattice is counted from the first step, so that leaping over steps changes no bit of the rest.
        after = first + np.float32(taken + 1) * step if cone == _ZERO else t + max(cone * t, step)
        if not after > t:
            # The step is lost to rounding, or not a number.
            return kept, taken, far
        end = min(after, far)
        middle = (t + end) / _TWO
        if middle >= free:
            ux, uy, uz = to_unit(
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
                    cells, gap = 1, np.int64(gaps[index(1 + (x >> shift)), index(1 + (y >> shift)), index(1 + (z >> shift))])
                    if gap > 0:
                        # All blocks less than ``gap`` away are empty too, on every side.
                        cells = (2 * gap - 1) << shift
                        x, y, z = (
                            ((x >> shift) - gap + 1) << shift,
                            ((y >> shift) - gap + 1) << shift,
                            ((z >> shift) - gap + 1) << shift,
                        )
                    out = min(_way_out(ux, x, cells, cell, pace_x), _way_out(uy, y, cells, cell, pace_y))
                    out = min(out, _way_out(uz, z, cells, cell, pace_z))
                    free = min(middle + out - MARGIN * (end - t), far)
                    if cone == _ZERO:
                        # To the first step whose middle is past the wall, or the one before; the comparison settles it.
                        error = ROUNDING * (abs(first) + abs(free))
                        leap = np.int64((free - first - error) * per_step + NEARLY_HALF)
                        if leap > taken + 1:
                            taken = leap - 1
                            end = min(first + np.float32(leap) * step, far)
        t = end
        taken += 1
    return kept, taken, t


@exact_parallel
def summarise(occupied, shift, gaps):
    """Set ``gaps`` to 0 for blocks that have an occupied cell, to a distance that no two blocks have for all others.

    ``gaps`` has one more block than the grid on every side.
    """
    resolution, far = occupied.shape[0], gaps.shape[0]
    for i in prange(gaps.shape[0]):
        gaps[i] = far
        for x in range(max(i - 1, 0) << shift, min(i << shift, resolution)):
            for y in range(resolution):
                for z in range(resolution):
                    if occupied[x, y, z]:
                        gaps[i, 1 + (y >> shift), 1 + (z >> shift)] = 0


@serial
def measure(gaps):
    """Turn the zeros of ``gaps`` into every block's distance to the nearest of them, the largest of its three coordinates.

    Two sweeps that look back at the 13 neighbours already visited give exactly that (Rosenfeld and Pfaltz 1968). The blocks
    on the rim of ``gaps`` are not part of the grid; they keep the neighbours' indices in range.
    """
    last = gaps.shape[0] - 2
    for sweep in range(2):
        back = 2 * sweep - 1
        for i in range(last):
            x = last - i if sweep else 1 + i
            for j in range(last):
                y = last - j if sweep else 1 + j
                for k in range(last):
                    z = last - k if sweep else 1 + k
                    nearest = min(gaps[x, y, z] - 1, gaps[x, y, z + back])
                    for w in range(z - 1, z + 2):
                        row = min(gaps[x + back, y - 1, w], gaps[x + back, y, w])
                        nearest = min(nearest, row, gaps[x + back, y + 1, w], gaps[x, y + back, w])
                    gaps[x, y, z] = nearest + 1


@exact_parallel
def walk(origins, directions, start, far, occupied, gaps, shift, box, contracted, step, cone, jobs, t0, t1, counts, resume):
    """March all rays; ray i keeps ``counts[i]`` intervals, in row i of ``t0`` and ``t1``."""
    for job in prange(jobs):
        # Neighbouring rays cost alike: dealing them out in turn balances the jobs.
        for i in range(job, len(start), jobs):
            counts[i], _, resume[i] = walk_ray(
                origins[i], directions[i], start[i], 0, start[i], far[i], occupied, gaps, shift, box, contracted, step, cone,
                t0[i], t1[i],
            )  # fmt: skip


@exact_parallel
def gather(t0, t1, counts, ends, first_ray, jobs, ray, packed0, packed1):
    """Write each ray's intervals behind one another."""
    for job in prange(jobs):
        for i in range(share(len(counts), jobs, job), share(len(counts), jobs, job + 1)):
            begin = ends[i] - counts[i]
            for k in range(counts[i]):
                at = index(begin + k)
                ray[at], packed0[at], packed1[at] = first_ray + i, t0[i, k], t1[i, k]


def surroundings(occupied: Bool[Tensor, "r r r"], bounds: Bounds) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """What a walk needs besides the ray: the box, its cells, blocks' distances to occupied ones, and the blocks' shift."""
    box = array(torch.cat([bounds.centre, bounds.half]).float())
    cells = array(occupied)
    shift = max(0, (-(-len(cells) // BLOCKS) - 1).bit_length())
    gaps = np.empty(3 * (2 - (-len(cells) >> shift),), np.int8)
    summarise(cells, shift, gaps)
    if bounds.space == "box":
        measure(gaps)
    return box, cells, gaps, shift


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`."""
    box, cells, gaps, shift = surroundings(occupied, bounds)
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
        walk(*lines, cells, gaps, shift, *settings, t0, t1, counts, resume[some].numpy())
        parts.append(packed(t0, t1, counts, first))
    if not parts:
        return March(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0), resume)
    ray, t0, t1 = parts[0] if len(parts) == 1 else (torch.cat(columns) for columns in zip(*parts, strict=True))
    return March(ray, t0, t1, resume)


def packed(t0: np.ndarray, t1: np.ndarray, counts: np.ndarray, first: int) -> tuple[Tensor, Tensor, Tensor]:
    """Ray, begin and end of all intervals: ``counts[i]`` of each row, which is ray ``first + i``."""
    ends = np.cumsum(counts)
    kept = int(ends[-1]) if len(ends) else 0
    columns = torch.empty(kept, dtype=torch.int64), torch.empty(kept), torch.empty(kept)
    gather(t0, t1, counts, ends, first, threads(), *(column.numpy() for column in columns))
    return columns


def longest(rays: Rays, start: Float[Tensor, " n"]) -> float:
    """Length of the longest way that a ray has before it."""
    return max(float((rays.far - start).nan_to_num(0.0).max()), 0.0) if len(rays) else 0.0


def _most(rays: Rays, start: Float[Tensor, " n"], steps: MarchSteps) -> int:
    """Most intervals that any ray can keep: steps are never shorter than ``steps.step``."""
    return min(steps.limit, int(min(longest(rays, start) / steps.step, steps.limit)) + 2)
