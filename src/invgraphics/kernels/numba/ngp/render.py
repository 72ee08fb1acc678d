"""Volume rendering of an Instant-NGP field in one fused pass: march, encode, evaluate, shade, composite.

Densities and colours are evaluated `POINTS` at a time; samples enter the colour network only if their weight exceeds the error
budget. No intermediate result is written to memory. Judged by `invgraphics.kernels.reference.ngp`.
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
    activate_density,
    encode,
    mlp,
    pack_network,
    radial_scale,
    sigmoid,
    softplus,
)
from invgraphics.kernels.numba.ngp.queue import (
    EDGE,
    current_interval,
    empty_queue,
    harmonics_offset,
    next_samples,
    queue_memory,
    terminate,
)
from invgraphics.kernels.numba.rays.composite import interval_alpha
from invgraphics.kernels.numba.rays.march import traversal_setup
from invgraphics.kernels.numba.runtime import LANES, array, index, inlined, parallel, prange, threads
from invgraphics.kernels.types import MarchSteps

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def composite_sample(s, raw, scale, queue, far, settings, sums, alpha):
    """Composite the sample of slot ``s``; return the weight of its colour, 0 below the error budget.

    ``scale`` multiplies the density of ``raw``; of ``settings`` (see `render`) those of colour are not looked at.
    """
    activation, bias, _, _, min_transmittance, max_error, _ = settings
    r = queue.ray_index[s]
    begin, end = current_interval(queue, s)
    queue.consumed[s] += 1
    transmitted, alpha_i = interval_alpha(activate_density(raw + bias, activation) * scale * (end - begin))
    weight = np.float32(queue.transmittance[s]) * alpha_i
    queue.transmittance[s] *= transmitted
    alpha[r] += weight
    sums[r, 3] += weight * ((begin + end) * _HALF)
    if queue.transmittance[s] < min_transmittance:
        terminate(queue, s, far)
    if queue.error[s] + weight <= max_error:
        queue.error[s] += weight
        weight = _ZERO
    return weight


@inlined
def _enqueue_sample(p, s, raw, harmonics, queued, latents, bands_squared, colour_inputs):
    """Append the colour network's inputs of batch lane ``p``, whose ray is in slot ``s``, to column ``queued``."""
    for k in range(latents):
        colour_inputs[index(k) * POINTS + index(queued)] = raw[index(1 + k) * POINTS + index(p)]
    for k in range(bands_squared):
        colour_inputs[index(latents + k) * POINTS + index(queued)] = harmonics[harmonics_offset(s) + index(k) * LANES]


@inlined
def _shade_queue(network, colour_inputs, ping, pong, sample_rays, weights, count, linear, sums):
    """Evaluate the colour network and add the weighted colours of the first ``count`` samples to their rays."""
    raw = mlp(network, colour_inputs, ping, pong)
    for n in range(count):
        r = sample_rays[n]
        for channel in range(3):
            value = raw[index(channel) * POINTS + index(n)]
            sums[r, channel] += weights[n] * (softplus(value) if linear else sigmoid(value))


@parallel
def render(rays, setup, table, levels, density_net, colour_net, widest, settings, width, queues, jobs, sums, alpha):
    """Sums of w * (radiance, distance) and of w for every ray; both outputs hold zeros before.

    Args:
        rays: origins, directions, starts and ends.
        setup: see `march.traversal_setup`.
        table: features, flat.
        levels: see `levels_of`.
        density_net: layers and sizes as `pack_network` returns them.
        colour_net: the same of the colour network.
        widest: largest number of inputs or outputs of any layer.
        settings: density activation, bias, whether radiance is linear, bands, minimum transmittance, error budget,
            `FusedNGP.contracted_density`.
        width: image width in pixels.
        queues: see `queue.queue_memory`.
        jobs: number of jobs.
        sums: output (n, 4).
        alpha: output (n,).
    """
    linear, bands_squared = settings[2], settings[3] * settings[3]
    latents = colour_net[1][0, 0] - bands_squared
    for job in prange(jobs):
        entries, encoding_weights = np.empty((2, 8 * BLOCK), np.uint32), np.empty((2, 8 * BLOCK), np.float32)
        points, size = np.zeros((3, POINTS), np.float32), widest * POINTS
        x, colour_inputs = np.zeros(size, np.float32), np.zeros(size, np.float32)
        ping, pong = np.zeros(size, np.float32), np.zeros(size, np.float32)
        ping_colour, pong_colour = np.zeros(size, np.float32), np.zeros(size, np.float32)
        sample_rays, weights, queued = np.zeros(POINTS, np.int64), np.zeros(POINTS, np.float32), 0
        queue = empty_queue(queues, job)
        while next_samples((job, jobs, width), rays, setup, queue, points):
            encode(table, levels, points, entries, encoding_weights, x)
            raw = mlp(density_net, x, ping, pong)
            for p in range(POINTS):
                s = queue.slots[p]
                scale = settings[6] * radial_scale(points, p) if settings[6] > _ZERO else _ONE
                weight = composite_sample(s, raw[p], scale, queue, rays[3], settings, sums, alpha) if s >= 0 else _ZERO
                if weight > _ZERO:
                    _enqueue_sample(p, s, raw, queue.harmonics, queued, latents, bands_squared, colour_inputs)
                    sample_rays[queued], weights[queued] = queue.ray_index[s], weight
                    queued += 1
                    if queued == POINTS:
                        _shade_queue(
                            colour_net, colour_inputs, ping_colour, pong_colour, sample_rays, weights, queued, linear, sums
                        )
                        queued = 0
        _shade_queue(colour_net, colour_inputs, ping_colour, pong_colour, sample_rays, weights, queued, linear, sums)


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
    """See `invgraphics.kernels.ngp_render`; other than two features per entry are left to the reference."""
    if field.table.shape[1] != 2:
        return reference.ngp_render(rays, occupied, bounds, steps, field, min_transmittance, max_error, width)
    batch_rays = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    density_net, colour_net = pack_network(field.density_net), pack_network(field.colour_net)
    settings = (
        ACTIVATIONS.index(field.density_activation),
        np.float32(field.density_bias),
        field.colour_space == "linear",
        field.sh_bands,
        float(min_transmittance),
        np.float32(max_error),
        np.float32(field.contracted_density),
    )
    widest = int(max(density_net[1].max(), colour_net[1].max()))
    sums, alpha = torch.zeros(len(rays), 4), torch.zeros(len(rays))
    model = array(field.table).reshape(-1), levels_of(field.grid), density_net, colour_net, widest
    setup, outputs = traversal_setup(occupied, bounds, steps), (sums.numpy(), alpha.numpy())
    # Rays that are no image are scheduled in order, as an image as wide as one block.
    render(batch_rays, setup, *model, settings, width or EDGE, queue_memory(threads()), threads(), *outputs)
    return sums, alpha
