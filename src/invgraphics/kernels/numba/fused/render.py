"""Volume rendering of a field over lattices in one fused pass: march, encode, evaluate, shade, composite.

As `ngp.render`, with its queue of rays and its networks; appearance is looked up for visible samples only. Judged by
`invgraphics.kernels.reference.fused`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.fused import FusedLattice
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.fused.heads import (
    FREQUENCY,
    apply_network,
    colours,
    contiguous,
    direction_rows,
    encode_points,
    pack_encoding,
    pack_head,
    pack_layers,
    points_scratch,
    points_words,
)
from invgraphics.kernels.numba.ngp.dense import POINTS
from invgraphics.kernels.numba.ngp.network import ACTIVATIONS, radial_scale_at
from invgraphics.kernels.numba.ngp.queue import EDGE, empty_queue, harmonics_offset, next_samples, queue_memory
from invgraphics.kernels.numba.ngp.render import composite_sample
from invgraphics.kernels.numba.rays.march import traversal_setup
from invgraphics.kernels.numba.runtime import GROUP, LANES, array, index, inlined, parallel, prange, threads
from invgraphics.kernels.numba.simd.partial import floats_at, longs_at
from invgraphics.kernels.types import MarchSteps

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def buffer_words(size):
    """Words that `buffers_at` takes; an even number."""
    return 3 * size + 4 * np.int64(POINTS)


@inlined
def buffers_at(address, size):
    """Positions (3, POINTS) and three arrays of ``size`` values."""
    arrays = address + 16 * np.int64(POINTS)
    a, b, c = floats_at(arrays, size), floats_at(arrays + 4 * size, size), floats_at(arrays + 8 * size, size)
    return floats_at(address, (3, np.int64(POINTS))), a, b, c


@inlined
def batch_at(address, size):
    """Inputs of the colour network, rays and weights of the queued samples."""
    n = np.int64(POINTS)
    return floats_at(address + 12 * n, size), longs_at(address, n), floats_at(address + 8 * n, n)


@inlined
def crop_points(points, crop):
    """From unit coordinates of the bounds to those of the field's box; see `pack_crop`."""
    if crop[2, 0] > _ZERO:
        for axis in range(3):
            for p in range(POINTS):
                points[axis, p] = (points[axis, p] - crop[0, axis]) * crop[1, axis]


@inlined
def density_scale(settings, points, crop, p):
    """Factor of the density of batch lane ``p``; ``settings`` end with `DensityHead.scale` and ``contracted``.

    ``points`` are those after `crop_points`; contraction is that of the bounds.
    """
    scale, contracted = settings[-2], settings[-1]
    if crop[2, 0] > _ZERO:
        for axis in range(3):
            if points[axis, p] < _ZERO or points[axis, p] > _ONE:
                return _ZERO
    if contracted > _ZERO:
        x, y, z = points[0, p], points[1, p], points[2, p]
        if crop[2, 0] > _ZERO:
            x, y, z = crop[0, 0] + x / crop[1, 0], crop[0, 1] + y / crop[1, 1], crop[0, 2] + z / crop[1, 2]
        scale = scale * (contracted * radial_scale_at(x, y, z))
    return scale


@inlined
def _enqueue_sample(p, s, raw, points, queue, queued, geometry_features, head, inputs, positions):
    """Append what the colour of batch lane ``p`` needs, whose ray is in slot ``s``, to column ``queued``."""
    features, octaves, direction, degree = head[2], head[3], head[4], head[5]
    n, first = index(queued), features * (1 + 2 * octaves)
    for axis in range(3):
        positions[axis, queued] = points[axis, p]
    for k in range(geometry_features):
        inputs[index(k) * POINTS + n] = raw[index(1 + k) * POINTS + index(p)]
    if direction == FREQUENCY:
        for axis in range(3):
            inputs[index(first + axis) * POINTS + n] = queue.lane_rays[index(3 + axis) * POINTS + index(p)]
    elif direction > 0:
        for k in range(degree * degree):
            inputs[index(first + k) * POINTS + n] = queue.harmonics[harmonics_offset(s) + index(k) * LANES]


@inlined
def _shade_queue(appearance, basis, colour_net, head, geometry_features, batch, room, sums):
    """Evaluate the colours of the queued samples and add them, weighted, to their rays."""
    inputs, positions, sample_rays, weights, count = batch
    corners, x, ping, pong = room
    if len(appearance[0]) > 0:
        encode_points(positions, appearance, corners, x)
        features = apply_network(basis, head[1], x, ping, pong)
        for number in range((head[2] - geometry_features) * np.int64(POINTS)):
            inputs[index(geometry_features) * POINTS + index(number)] = features[index(number)]
    found = colours(inputs, colour_net, head, ping, pong)
    for n in range(count):
        for channel in range(3):
            sums[sample_rays[n], channel] += weights[n] * found[index(channel) * POINTS + index(n)]


@parallel
def render(
    rays, setup, geometry, appearance, geometry_net, basis, colour_net, head, geometry_features, crop, sizes, memory, settings,
    width, queues, jobs, sums, alpha,
):  # fmt: skip
    """Sums of w * (radiance, distance) and of w for every ray; both outputs hold zeros before.

    Args:
        rays: origins, directions, starts and ends.
        setup: see `rays.march.traversal_setup`.
        geometry: see `heads.pack_encoding`.
        appearance: the same; no lattices for none.
        geometry_net: see `heads.pack_layers`.
        basis: the same of appearance's features.
        colour_net: the same of colour.
        head: see `heads.pack_head`.
        geometry_features: number of features that geometry hands on to colour.
        crop: see `pack_crop`.
        sizes: see `sizes_of`.
        memory: address of the scratch of all jobs.
        settings: those of `ngp.render.composite_sample`, then scale and contracted scale of the density.
        width: image width in pixels.
        queues: see `ngp.queue.queue_memory`.
        jobs: number of jobs.
        sums: output (n, 4).
        alpha: output (n,).
    """
    smooth, compositing, size = head[1], settings[:7], np.int64(sizes[0]) * np.int64(POINTS)
    for job in prange(jobs):
        own = memory + 4 * np.int64(job) * sizes[3]
        corners, rest = points_scratch(own, geometry), own + 4 * sizes[1]
        points, x, ping, pong = buffers_at(rest + 4 * sizes[2], size)
        positions, x_colour, ping_colour, pong_colour = buffers_at(rest + 4 * (sizes[2] + buffer_words(size)), size)
        inputs, sample_rays, weights = batch_at(rest + 4 * (sizes[2] + 2 * buffer_words(size)), size)
        room = points_scratch(rest, appearance), x_colour, ping_colour, pong_colour
        queue, queued = empty_queue(queues, job), 0
        while next_samples((job, jobs, width), rays, setup, queue, points):
            crop_points(points, crop)
            encode_points(points, geometry, corners, x)
            raw = apply_network(geometry_net, smooth, x, ping, pong)
            for p in range(POINTS):
                s, weight = queue.slots[p], _ZERO
                if s >= 0:
                    scale = density_scale(settings, points, crop, p)
                    weight = composite_sample(s, raw[p], scale, queue, rays[3], compositing, sums, alpha)
                if weight > _ZERO:
                    _enqueue_sample(p, s, raw, points, queue, queued, geometry_features, head, inputs, positions)
                    sample_rays[queued], weights[queued] = queue.ray_index[s], weight
                    queued += 1
                    if queued == POINTS:
                        batch = inputs, positions, sample_rays, weights, queued
                        _shade_queue(appearance, basis, colour_net, head, geometry_features, batch, room, sums)
                        queued = 0
        batch = inputs, positions, sample_rays, weights, queued
        _shade_queue(appearance, basis, colour_net, head, geometry_features, batch, room, sums)


def pack_crop(field: FusedLattice) -> np.ndarray:
    """Lowest corner and inverse edges of the field's box, and 1 where it is not all of the bounds, in rows."""
    lo, hi = (np.array(corner, np.float32) for corner in field.crop or ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    return np.stack([lo, _ONE / (hi - lo), np.full(3, field.crop is not None, np.float32)])


def sizes_of(rows: int, geometry: int, appearance: int) -> tuple[int, int, int, int]:
    """Most rows of any array of features, words of scratch for each encoding, and for a job in all."""
    points = int(POINTS)
    return rows, geometry, appearance, geometry + appearance + 7 * rows * points + 11 * points


@torch.no_grad()
def lattice_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedLattice,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.lattice_render`."""
    batch_rays = tuple(array(part) for part in (rays.origins, rays.directions, rays.near, rays.far))
    # The encodings hold what the kernel has addresses of.
    encodings = contiguous(field.geometry), contiguous(field.appearance)
    geometry, appearance = (pack_encoding(encoding) for encoding in encodings)
    networks = tuple(pack_layers(layers) for layers in (field.geometry_net, field.basis, field.colour.net))
    head, density = pack_head(field), field.density
    compositing = (
        ACTIVATIONS.index(density.activation), np.float32(density.bias), False, 0, float(min_transmittance),
        np.float32(max_error), _ZERO,
    )  # fmt: skip
    settings = *compositing, np.float32(density.scale), np.float32(density.contracted)
    inputs = head[2] * (1 + 2 * head[3]) + direction_rows(head)
    rows = [inputs, geometry[1], appearance[1], *(int(x.max()) for _, x in networks if len(x))]
    sizes, jobs = sizes_of(max(rows) + GROUP, points_words(geometry), points_words(appearance)), threads()
    # Zeros: what no sample has written to yet is evaluated, and thrown away.
    memory = np.zeros(jobs * sizes[3], np.float32)
    model = geometry, appearance, *networks, head, field.geometry_features, pack_crop(field), sizes, memory.ctypes.data
    sums, alpha = torch.zeros(len(rays), 4), torch.zeros(len(rays))
    outputs = sums.numpy(), alpha.numpy()
    # Rays that are no image are scheduled in order, as an image as wide as one block.
    render(
        batch_rays,
        traversal_setup(occupied, bounds, steps),
        *model,
        settings,
        width or EDGE,
        queue_memory(jobs),
        jobs,
        *outputs,
    )
    return sums, alpha
