"""Occupancy-grid ray marching with empty-space skipping: the distance map, and packed intervals of many rays."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.rays.traversal import (
    OCCUPIED,
    RAY_FLOATS,
    STATE_FLOATS,
    idle_lane,
    march_rays,
    read_state,
    set_ray,
    set_state,
)
from invgraphics.kernels.numba.runtime import GROUP, array, exact_parallel, index, job_start, prange, scratch, serial, threads
from invgraphics.kernels.types import March, MarchSteps

MAX_INTERVALS = 1 << 22
"""Maximum number of intervals of one batch of rays, which bounds memory."""
_ZERO = np.float32(0.0)

CONTRACTED_LENGTH = 12.0
"""Bound of a ray's contracted length, in half-extents: 4 along the radius, 2 pi across it, and some slack."""

BLOCKS = 32
"""Maximum number of blocks along the grid's edge; a block's edge is a power of two, ``1 << shift`` cells."""


@exact_parallel
def occupied_blocks(occupied, shift, distances):
    """Downsample an occupancy grid to blocks: ``distances`` is 0 for occupied blocks, larger than any distance elsewhere.

    ``distances`` is padded by one block on every side.
    """
    resolution, far = occupied.shape[0], distances.shape[0]
    for i in prange(distances.shape[0]):
        distances[i] = far
        for x in range(max(i - 1, 0) << shift, min(i << shift, resolution)):
            for y in range(resolution):
                for z in range(resolution):
                    if occupied[x, y, z]:
                        distances[i, 1 + (y >> shift), 1 + (z >> shift)] = 0


@serial
def distance_transform(distances):
    """Chebyshev distance transform in place: every block's distance to the nearest zero of ``distances``.

    Two sweeps over the 13 neighbours already visited are exact (Rosenfeld and Pfaltz 1968). The padding is not part of the
    grid; it keeps the neighbours' indices in range.
    """
    last = distances.shape[0] - 2
    for sweep in range(2):
        back = 2 * sweep - 1
        for i in range(last):
            x = last - i if sweep else 1 + i
            for j in range(last):
                y = last - j if sweep else 1 + j
                for k in range(last):
                    z = last - k if sweep else 1 + k
                    nearest = min(distances[x, y, z] - 1, distances[x, y, z + back])
                    for w in range(z - 1, z + 2):
                        row = min(distances[x + back, y - 1, w], distances[x + back, y, w])
                        nearest = min(nearest, row, distances[x + back, y + 1, w], distances[x, y + back, w])
                    distances[x, y, z] = nearest + 1


@exact_parallel
def distance_map(occupied, shift, blocks, distances):
    """Distance map: per cell `OCCUPIED`, or the distance in blocks to the nearest block with an occupied cell."""
    resolution = occupied.shape[0]
    for x in prange(resolution):
        for y in range(resolution):
            for z in range(resolution):
                distance = blocks[1 + (x >> shift), 1 + (y >> shift), 1 + (z >> shift)]
                distances[x, y, z] = OCCUPIED if occupied[x, y, z] else distance


@exact_parallel
def traverse(origins, directions, start, far, setup, jobs, t0, t1, counts, resume):
    """March all rays; ray i has ``counts[i]`` intervals in row i of ``t0`` and ``t1``, which have one row to spare."""
    n, width = len(start), t0.shape[1]
    for job in prange(jobs):
        lane_rays, state = np.zeros(RAY_FLOATS * GROUP, np.float32), np.zeros(STATE_FLOATS * GROUP, np.float32)
        # Neighbouring rays cost alike: round-robin groups balance the jobs.
        for begin in range(job * GROUP, n, jobs * GROUP):
            for lane in range(GROUP):
                r = begin + lane
                if r < n:
                    set_ray(lane_rays, lane, origins, directions, r, start[r], far[r])
                    set_state(state, lane, r * width, _ZERO, start[r])
                else:
                    idle_lane(lane_rays, state, lane, n * width)
            march_rays(lane_rays, state, np.float32(width - 1), setup, t0.reshape(-1), t1.reshape(-1))
            for lane in range(min(GROUP, n - begin)):
                counts[begin + lane], _, resume[begin + lane] = read_state(state, lane)


@exact_parallel
def pack(t0, t1, counts, ends, first_ray, jobs, ray, packed0, packed1):
    """Pack the rows of intervals into flat arrays, ray after ray."""
    for job in prange(jobs):
        for i in range(job_start(len(counts), jobs, job), job_start(len(counts), jobs, job + 1)):
            begin = ends[i] - counts[i]
            for k in range(counts[i]):
                at = index(begin + k)
                ray[at], packed0[at], packed1[at] = first_ray + i, t0[i, k], t1[i, k]


def traversal_setup(
    occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps
) -> tuple[np.ndarray, np.ndarray, int, bool, np.float32, np.float32, bool]:
    """Everything that `traversal.march_rays` needs besides the rays.

    Returns:
        The box (centre, half edges); the distance map (see `distance_map`); log2 of a block's edge in cells; whether space is
        contracted; step length; cone angle; and whether steps are uniform after contraction.
    """
    box, contracted = array(torch.cat([bounds.centre, bounds.half]).float()), bounds.space == "contracted"
    cells = array(occupied)
    shift = max(0, (-(-len(cells) // BLOCKS) - 1).bit_length())
    blocks, distances = np.empty(3 * (2 - (-len(cells) >> shift),), np.int8), np.empty(cells.shape, np.int8)
    occupied_blocks(cells, shift, blocks)
    if not contracted:
        distance_transform(blocks)
    distance_map(cells, shift, blocks, distances)
    return box, distances, shift, contracted, np.float32(steps.step), np.float32(steps.cone), steps.contracted


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`."""
    setup = traversal_setup(occupied, bounds, steps)
    resume = torch.empty(len(rays))
    parts = []
    # A row has space for one interval more than it may keep.
    width = 1 + min(max_steps(rays, bounds, start, steps), steps.limit)
    batch = max(1, MAX_INTERVALS // width)
    for first in range(0, len(rays), batch):
        some = slice(first, min(first + batch, len(rays)))
        n = some.stop - first
        t0, t1 = (scratch(name, (n + 1) * width).reshape(n + 1, width) for name in ("march t0", "march t1"))
        counts = np.empty(n, np.int64)
        batch_rays = (array(x[some]) for x in (rays.origins, rays.directions, start, rays.far))
        traverse(*batch_rays, setup, threads(), t0, t1, counts, resume[some].numpy())
        parts.append(pack_intervals(t0, t1, counts, first))
    if not parts:
        return March(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0), resume)
    ray, t0, t1 = parts[0] if len(parts) == 1 else (torch.cat(columns) for columns in zip(*parts, strict=True))
    return March(ray, t0, t1, resume)


def pack_intervals(t0: np.ndarray, t1: np.ndarray, counts: np.ndarray, first: int) -> tuple[Tensor, Tensor, Tensor]:
    """Packed ray indices, starts and ends: the first ``counts[i]`` intervals of each row i, which is ray ``first + i``."""
    ends = np.cumsum(counts)
    kept = int(ends[-1]) if len(ends) else 0
    columns = torch.empty(kept, dtype=torch.int64), torch.empty(kept), torch.empty(kept)
    pack(t0, t1, counts, ends, first, threads(), *(column.numpy() for column in columns))
    return columns


def longest_extent(rays: Rays, start: Float[Tensor, " n"]) -> float:
    """Largest distance from start to far over all rays."""
    return max(float((rays.far - start).nan_to_num(0.0).max()), 0.0) if len(rays) else 0.0


def max_steps(rays: Rays, bounds: Bounds, start: Float[Tensor, " n"], steps: MarchSteps) -> int:
    """Upper bound of the steps of any ray: none is shorter than ``steps.step``.

    A line is at most 2 pi half-extents long after contraction: its turn as seen from the centre, at a radius below 2.
    """
    length = longest_extent(rays, start)
    if steps.contracted:
        length = min(length, CONTRACTED_LENGTH * float(bounds.half.max()))
    return int(length / steps.step) + 2
