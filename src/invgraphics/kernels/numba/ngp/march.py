"""Walking along rays through a hash grid until something opaque is met: march, look-ups and networks in one pass."""

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
from invgraphics.kernels.numba.ngp.network import ACTIVATIONS, density_of, encode, outputs_of, packed_network, radial_scale
from invgraphics.kernels.numba.ngp.queue import EDGE, fill, no_rays, step_of, stop
from invgraphics.kernels.numba.rays.composite import absorb
from invgraphics.kernels.numba.rays.march import ROOM, most_steps, packed, surroundings
from invgraphics.kernels.numba.runtime import array, inlined, parallel, prange, scratch, threads
from invgraphics.kernels.types import March, MarchSteps

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _keep(s, said, scale, way, far, settings, rows, counts):
    """Write down the step of slot ``s``, of which ``said`` was said, and let its ray go on if light is left behind it.

    ``scale`` is what the density is multiplied with.
    """
    activation, bias, opaque, _ = settings
    r = way.which[s]
    begin, end = step_of(way, s)
    way.done[s] += 1
    rows[0, r, counts[r]], rows[1, r, counts[r]] = begin, end
    counts[r] += 1
    passed, _ = absorb(density_of(said + bias, activation) * scale * (end - begin))
    way.light[s] *= passed
    if way.light[s] < opaque:
        stop(way, s, far)


@parallel
def reach(rays, space, table, levels, geometry, settings, jobs, rows, counts):
    """Steps of every ray that light reaches, in ``rows``: begin and end; ``counts`` of them, which are 0 before.

    Arguments as in `ngp_render.render`; ``settings`` are activation, bias, least transmittance, and
    `FusedNGP.contracted_density`.
    """
    sizes = geometry[1]
    for job in prange(jobs):
        entries, shares = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, room = np.zeros((3, POINTS), np.float32), sizes.max() * POINTS
        x, odd, even = np.zeros(room, np.float32), np.zeros(room, np.float32), np.zeros(room, np.float32)
        way = no_rays()
        while fill((job, jobs, EDGE), rays, space, way, points):
            encode(table, levels, points, entries, shares, x)
            said = outputs_of(geometry, x, odd, even)
            for p in range(POINTS):
                if way.slots[p] >= 0:
                    scale = settings[3] * radial_scale(points, p) if settings[3] > _ZERO else _ONE
                    _keep(way.slots[p], said[p], scale, way, rays[3], settings, rows, counts)


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
    """See `invgraphics.kernels.ngp_march`; steps that grow with a cone and other widths are left to the reference."""
    endless = bounds.space == "contracted" and not steps.contracted
    if field.table.shape[1] != 2 or steps.cone > 0 or endless:
        return reference.ngp_march(rays, occupied, bounds, steps, field, start, min_transmittance)
    space = surroundings(occupied, bounds, steps)
    # The first output alone: nobody asks for a colour.
    *hidden, (weight, bias) = field.density_net
    model = array(field.table).reshape(-1), levels_of(field.grid), packed_network((*hidden, (weight[:1], bias[:1])))
    settings = (
        ACTIVATIONS.index(field.density_activation),
        np.float32(field.density_bias),
        float(min_transmittance),
        np.float32(field.contracted_density),
    )
    most = most_steps(rays, bounds, start, steps)
    batch, found = max(1, ROOM // most), []
    for first in range(0, max(len(rays), 1), batch):
        lines = tuple(array(x[first : first + batch]) for x in (rays.origins, rays.directions, start, rays.far))
        n = len(lines[2])
        rows, counts = scratch("reached", 2 * n * most).reshape(2, n, most), np.zeros(n, np.int64)
        reach(lines, space, *model, settings, threads(), rows, counts)
        found.append(packed(rows[0], rows[1], counts, first))
    ray, t0, t1 = (torch.cat(columns) for columns in zip(*found, strict=True))
    return March(ray, t0, t1, torch.maximum(start, rays.far))
