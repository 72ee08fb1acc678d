"""Pictures of a hash grid in one pass: walking, looking up, networks and compositing.

Colours are asked for `POINTS` at a time, like densities, but only where they count. Nothing is written to memory but the
picture.
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
from invgraphics.kernels.numba.ngp.network import (
    ACTIVATIONS,
    density_of,
    encode,
    outputs_of,
    packed_network,
    radial_scale,
    sigmoid,
    softplus,
)
from invgraphics.kernels.numba.ngp.queue import EDGE, fill, no_rays, step_of, stop, view_of
from invgraphics.kernels.numba.rays.composite import absorb
from invgraphics.kernels.numba.rays.march import surroundings
from invgraphics.kernels.numba.runtime import LANES, array, index, inlined, parallel, prange, threads
from invgraphics.kernels.types import MarchSteps

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def _meet(s, said, scale, way, far, settings, sums, alpha):
    """Composite the step of slot ``s``, of which ``said`` was said; returns its colour's weight, 0 if nobody will miss it.

    ``scale`` is what the density is multiplied with.
    """
    activation, bias, _, _, opaque, unseen, _ = settings
    r = way.which[s]
    begin, end = step_of(way, s)
    way.done[s] += 1
    passed, opacity = absorb(density_of(said + bias, activation) * scale * (end - begin))
    weight = np.float32(way.light[s]) * opacity
    way.light[s] *= passed
    alpha[r] += weight
    sums[r, 3] += weight * ((begin + end) * _HALF)
    if way.light[s] < opaque:
        stop(way, s, far)
    if way.missed[s] + weight <= unseen:
        way.missed[s] += weight
        weight = _ZERO
    return weight


@inlined
def _ask(p, s, said, views, waiting, handed, harmonic, asked):
    """Put what the colour network wants to know of place ``p``, whose ray is in slot ``s``, at the end of the queue."""
    for k in range(handed):
        asked[index(k) * POINTS + index(waiting)] = said[index(1 + k) * POINTS + index(p)]
    for k in range(harmonic):
        asked[index(handed + k) * POINTS + index(waiting)] = views[view_of(s) + index(k) * LANES]


@inlined
def _answer(network, asked, odd, even, whose, weights, count, linear, sums):
    """Add the colours of the first ``count`` places of the queue to their rays."""
    raw = outputs_of(network, asked, odd, even)
    for n in range(count):
        r = whose[n]
        for channel in range(3):
            value = raw[index(channel) * POINTS + index(n)]
            sums[r, channel] += weights[n] * (softplus(value) if linear else sigmoid(value))


@parallel
def render(rays, space, table, levels, geometry, colour, widest, settings, width, jobs, sums, alpha):
    """Sums of w * (radiance, distance) and of w for every ray; both hold zeros.

    Args:
        rays: their origins, directions, starts and ends.
        space: see `march.surroundings`.
        table: features, flat.
        levels: see `levels_of`.
        geometry: layers of the density's network as `packed_network`, and their inputs and padded outputs.
        colour: the same of the radiance's.
        widest: most inputs or outputs of any layer.
        settings: activation, bias, whether radiance is linear, bands, least transmittance, most weight of a ray to leave out,
            `FusedNGP.contracted_density`.
        width: pixels of a row of the picture.
        jobs: number of jobs.
        sums: output (n, 4).
        alpha: output (n,).
    """
    linear, harmonic = settings[2], settings[3] * settings[3]
    handed = colour[1][0, 0] - harmonic
    for job in prange(jobs):
        entries, shares = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, room = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, asked = np.zeros(room, np.float32), np.zeros(room, np.float32)
        odd, even = np.zeros(room, np.float32), np.zeros(room, np.float32)
        odd_colour, even_colour = np.zeros(room, np.float32), np.zeros(room, np.float32)
        whose, weights, waiting = np.zeros(POINTS, np.int64), np.zeros(POINTS, np.float32), 0
        way = no_rays()
        while fill((job, jobs, width), rays, space, way, points):
            encode(table, levels, points, entries, shares, x)
            said = outputs_of(geometry, x, odd, even)
            for p in range(POINTS):
                s = way.slots[p]
                scale = settings[6] * radial_scale(points, p) if settings[6] > _ZERO else _ONE
                weight = _meet(s, said[p], scale, way, rays[3], settings, sums, alpha) if s >= 0 else _ZERO
                if weight > _ZERO:
                    _ask(p, s, said, way.views, waiting, handed, harmonic, asked)
                    whose[waiting], weights[waiting] = way.which[s], weight
                    waiting += 1
                    if waiting == POINTS:
                        _answer(colour, asked, odd_colour, even_colour, whose, weights, waiting, linear, sums)
                        waiting = 0
        _answer(colour, asked, odd_colour, even_colour, whose, weights, waiting, linear, sums)


@torch.no_grad()
def ngp_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedNGP,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.ngp_render`; what has other than two features per entry is left to the reference."""
    if field.table.shape[1] != 2:
        return reference.ngp_render(rays, occupied, bounds, steps, field, min_transmittance, max_error, width)
    lines = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    geometry, colour = packed_network(field.density_net), packed_network(field.colour_net)
    settings = (
        ACTIVATIONS.index(field.density_activation),
        np.float32(field.density_bias),
        field.colour_space == "linear",
        field.sh_bands,
        float(min_transmittance),
        np.float32(max_error),
        np.float32(field.contracted_density),
    )
    widest = int(max(geometry[1].max(), colour[1].max()))
    sums, alpha = torch.zeros(len(rays), 4), torch.zeros(len(rays))
    model = array(field.table).reshape(-1), levels_of(field.grid), geometry, colour, widest
    space, outputs = surroundings(occupied, bounds, steps), (sums.numpy(), alpha.numpy())
    # Rays of no picture are taken in order, as if rows were as wide as blocks.
    render(lines, space, *model, settings, width or EDGE, threads(), *outputs)
    return sums, alpha
