"""Walks of many rays through an occupancy grid, and the map of the ways that they find."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.rays.traversal import MARKS, NUMBERS, OCCUPIED, marks_of, no_ray, set_marks, set_ray, walk_rays
from invgraphics.kernels.numba.runtime import GROUP, array, exact_parallel, index, prange, scratch, serial, share, threads
from invgraphics.kernels.types import March, MarchSteps

ROOM = 1 << 22
"""Most intervals that one batch of rays may keep, which bounds memory."""
_ZERO = np.float32(0.0)

CONTRACTED_LENGTH = 12.0
"""No line is longer than this after contraction, in half-extents: 4 along the radius, 2 pi across it, and some room."""

BLOCKS = 32
"""Most blocks along the grid's edge; their edges are powers of two, ``1 << shift`` cells long."""


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
def draw_map(occupied, shift, gaps, ways):
    """``ways``: for every cell `OCCUPIED`, or how many blocks away the nearest block with an occupied cell is."""
    resolution = occupied.shape[0]
    for x in prange(resolution):
        for y in range(resolution):
            for z in range(resolution):
                gap = gaps[1 + (x >> shift), 1 + (y >> shift), 1 + (z >> shift)]
                ways[x, y, z] = OCCUPIED if occupied[x, y, z] else gap


@exact_parallel
def walk(origins, directions, start, far, space, jobs, t0, t1, counts, resume):
    """March all rays; ray i keeps ``counts[i]`` intervals, in row i of ``t0`` and ``t1``, which have a row to spare."""
    n, width = len(start), t0.shape[1]
    for job in prange(jobs):
        lines, marks = np.zeros(NUMBERS * GROUP, np.float32), np.zeros(MARKS * GROUP, np.float32)
        # Neighbouring rays cost alike: dealing them out in turn balances the jobs.
        for begin in range(job * GROUP, n, jobs * GROUP):
            for lane in range(GROUP):
                r = begin + lane
                if r < n:
                    set_ray(lines, lane, origins, directions, r, start[r], far[r])
                    set_marks(marks, lane, r * width, _ZERO, start[r])
                else:
                    no_ray(lines, marks, lane, n * width)
            walk_rays(lines, marks, np.float32(width - 1), space, t0.reshape(-1), t1.reshape(-1))
            for lane in range(min(GROUP, n - begin)):
                counts[begin + lane], _, resume[begin + lane] = marks_of(marks, lane)


@exact_parallel
def gather(t0, t1, counts, ends, first_ray, jobs, ray, packed0, packed1):
    """Write each ray's intervals behind one another."""
    for job in prange(jobs):
        for i in range(share(len(counts), jobs, job), share(len(counts), jobs, job + 1)):
            begin = ends[i] - counts[i]
            for k in range(counts[i]):
                at = index(begin + k)
                ray[at], packed0[at], packed1[at] = first_ray + i, t0[i, k], t1[i, k]


def surroundings(
    occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps
) -> tuple[np.ndarray, np.ndarray, int, bool, np.float32, np.float32, bool]:
    """What a walk needs besides the rays.

    The box (centre, half edges); of every cell whether it is occupied, or how many blocks away the nearest block with an
    occupied cell is; the blocks' shift; whether space is contracted; the steps' length and the cone's slope; and whether
    steps are equal after contraction.
    """
    box, contracted = array(torch.cat([bounds.centre, bounds.half]).float()), bounds.space == "contracted"
    cells = array(occupied)
    shift = max(0, (-(-len(cells) // BLOCKS) - 1).bit_length())
    gaps, ways = np.empty(3 * (2 - (-len(cells) >> shift),), np.int8), np.empty(cells.shape, np.int8)
    summarise(cells, shift, gaps)
    if not contracted:
        measure(gaps)
    draw_map(cells, shift, gaps, ways)
    return box, ways, shift, contracted, np.float32(steps.step), np.float32(steps.cone), steps.contracted


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`."""
    space = surroundings(occupied, bounds, steps)
    resume = torch.empty(len(rays))
    parts = []
    # A row has room for one interval more than it keeps.
    width = 1 + min(most_steps(rays, bounds, start, steps), steps.limit)
    batch = max(1, ROOM // width)
    for first in range(0, len(rays), batch):
        some = slice(first, min(first + batch, len(rays)))
        n = some.stop - first
        t0, t1 = (scratch(name, (n + 1) * width).reshape(n + 1, width) for name in ("march t0", "march t1"))
        counts = np.empty(n, np.int64)
        lines = (array(x[some]) for x in (rays.origins, rays.directions, start, rays.far))
        walk(*lines, space, threads(), t0, t1, counts, resume[some].numpy())
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


def most_steps(rays: Rays, bounds: Bounds, start: Float[Tensor, " n"], steps: MarchSteps) -> int:
    """Most steps that any ray can take: none is shorter than ``steps.step``.

    A line is at most 2 pi half-extents long after contraction: its turn as seen from the centre, at a radius below 2.
    """
    length = longest(rays, start)
    if steps.contracted:
        length = min(length, CONTRACTED_LENGTH * float(bounds.half.max()))
    return int(length / steps.step) + 2
