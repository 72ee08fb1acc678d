"""Benchmark cases of volume rendering: encodings, marching, compositing and fused rendering."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.bench import limits
from invgraphics.bench.case import LARGE, Case, KernelPass
from invgraphics.bench.results import BOTH, FORWARD
from invgraphics.bench.splat_cases import forward_backward, without_gradient
from invgraphics.bench.workload import bounds, camera, occupied
from invgraphics.core import Rays
from invgraphics.core.ngp import FusedNGP, HashGrid
from invgraphics.kernels.types import MarchSteps

GATE = {"levels": 16, "log2_size": 15, "points": 1 << 16}
"""Size of the gate on hash encoding."""

HASH_SIZES = ((15, 14), (15, 16), (15, 18), (17, 16), (19, 16), (19, 18))
"""log2 of entries per level, and of points."""
QUICK_HASH_SIZES = ((15, 14), (15, 16))
LEVELS, BASE, FINEST = 16, 16, 4096
"""Instant-NGP's pyramid with a growth of 1.447 per level."""
MOST_FOR_REFERENCE = 1 << 16
"""Points beyond which the reference is skipped: its autograd graph holds every corner of every level."""

OCCUPANCY, STEPS_PER_DIAGONAL = 128, 1024
MARCH_RAYS, QUICK_MARCH_RAYS = (1 << 10, 1 << 12, 1 << 14), (1 << 10, 1 << 12)
IMAGE_WIDTH = 400
"""Edge of the image from whose pixels rays are drawn at random."""
MARCH_BYTES = 8 + 4 + 4
"""Bytes written per interval: ray index, start, end."""

NGP_GRID = HashGrid(levels=10, log2_size=18, base=16, finest=1024)
NGP_WIDTH, LATENTS, BANDS, NGP_STEPS = 64, 15, 4, 256
"""A hash field of the size that is fitted in minutes, and steps across the diagonal."""
NGP_RAYS, QUICK_NGP_RAYS = (1 << 10, 1 << 12, 1 << 14), (1 << 10, 1 << 12)

COMPOSITE_SAMPLES, QUICK_COMPOSITE_SAMPLES = (1 << 16, 1 << 18, 1 << 20), (1 << 16, 1 << 18)
SAMPLES_PER_RAY, CHANNELS = 32, 4
COMPOSITE_BYTES = {FORWARD: 4 + 4 * CHANNELS + 8 + 4 + 4, BOTH: 2 * (4 + 4 * CHANNELS + 8 + 4 + 4) + 4 + 4 * CHANNELS}
"""Per sample: depth, channels and ray are read, two numbers kept; backward, those are read again and gradients written."""


def hash_encode(quick: bool) -> Iterator[Case]:
    """The multi-resolution hash encoding over table sizes and points."""
    for log2_size, log2_points in QUICK_HASH_SIZES if quick else HASH_SIZES:
        points = 1 << log2_points
        sizes = {"levels": LEVELS, "log2_size": log2_size, "points": points}
        why = LARGE if points > MOST_FOR_REFERENCE else ""
        yield Case("hash_encode", sizes, lambda size=log2_size, points=points: _hash(size, points), why)


def ray_march(quick: bool) -> Iterator[Case]:
    """Marching through an occupancy grid over rays."""
    for rays in QUICK_MARCH_RAYS if quick else MARCH_RAYS:
        yield Case("ray_march", {"resolution": OCCUPANCY, "rays": rays}, lambda rays=rays: _march(rays))


def ngp_render(quick: bool) -> Iterator[Case]:
    """Fused rendering of a hash grid over rays; nothing is opaque, so that every interval is evaluated."""
    for rays in QUICK_NGP_RAYS if quick else NGP_RAYS:
        yield Case("ngp_render", {"resolution": OCCUPANCY, "rays": rays}, lambda rays=rays: _ngp_render(rays))


def composite(quick: bool) -> Iterator[Case]:
    """Emission-absorption sums over samples."""
    for samples in QUICK_COMPOSITE_SAMPLES if quick else COMPOSITE_SAMPLES:
        yield Case("composite", {"channels": CHANNELS, "samples": samples}, lambda samples=samples: _composite(samples))


def ray_ordered(points: int) -> Float[Tensor, "m 3"]:
    """Points in the unit cube in a renderer's order: `SAMPLES_PER_RAY` along each of many random rays."""
    generator = torch.Generator().manual_seed(0)
    rays = math.ceil(points / SAMPLES_PER_RAY)
    begin, end = (torch.rand(rays, 1, 3, generator=generator) for _ in range(2))
    along = (torch.arange(SAMPLES_PER_RAY) + 0.5)[None, :, None] / SAMPLES_PER_RAY
    return (begin + along * (end - begin)).reshape(-1, 3)[:points].contiguous()


def _hash(log2_size: int, points: int) -> dict[str, KernelPass]:
    grid = HashGrid(LEVELS, 2, log2_size, BASE, FINEST)
    table = torch.rand(grid.entries, 2, generator=torch.Generator().manual_seed(0)).requires_grad_()
    unit = ray_ordered(points)
    encode = lambda: kernels.hash_encode(unit, table, grid)[0]  # noqa: E731
    # Gather rate of one level's table: an upper bound, whatever the order of points and levels.
    limit = limits.gather(8 << log2_size)
    amount = 8.0 * LEVELS * points
    return {
        FORWARD: KernelPass(without_gradient(encode), amount, limit, "look-ups"),
        BOTH: KernelPass(forward_backward(encode, [table]), 2 * amount, limit, "look-ups"),
    }


def _march(count: int) -> dict[str, KernelPass]:
    region, cells, rays = bounds(), occupied(OCCUPANCY), some_rays(count)
    steps = MarchSteps(2 * region.radius / STEPS_PER_DIAGONAL)
    march = lambda: kernels.ray_march(rays, cells, region, steps, rays.near)  # noqa: E731
    return {FORWARD: KernelPass(march, float(MARCH_BYTES * len(march().ray)), limits.triad(), "bytes")}


def random_ngp() -> FusedNGP:
    """Random hash grid and networks: a semi-transparent fog."""
    generator = torch.Generator().manual_seed(0)

    def network(*widths: int) -> tuple[tuple[Tensor, Tensor], ...]:
        sizes = itertools.pairwise(widths)
        return tuple((torch.randn(outs, ins, generator=generator) / ins**0.5, torch.zeros(outs)) for ins, outs in sizes)

    table = torch.randn(NGP_GRID.entries, 2, generator=generator)
    geometry = network(2 * NGP_GRID.levels, NGP_WIDTH, 1 + LATENTS)
    colour = network(LATENTS + BANDS**2, NGP_WIDTH, NGP_WIDTH, 3)
    return FusedNGP(table, NGP_GRID, geometry, colour, "exp", 0.0, BANDS, "srgb")


def _ngp_render(count: int) -> dict[str, KernelPass]:
    field, region, cells, rays = random_ngp(), bounds(), occupied(OCCUPANCY), some_rays(count)
    steps = MarchSteps(2 * region.radius / NGP_STEPS)
    render = lambda: kernels.ngp_render(rays, cells, region, steps, field)  # noqa: E731
    products = sum(weight.numel() for weight, _ in field.density_net + field.colour_net)
    evaluations = len(kernels.ray_march(rays, cells, region, steps, rays.near).ray)
    return {FORWARD: KernelPass(render, 2.0 * products * evaluations, limits.sgemm(), "flop")}


def some_rays(count: int) -> Rays:
    """Rays of random pixels of a picture of the object, clipped to its bounds."""
    pixels = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * IMAGE_WIDTH
    return bounds().clip(camera(IMAGE_WIDTH).rays(pixels.floor() + 0.5))


def _composite(samples: int) -> dict[str, KernelPass]:
    generator = torch.Generator().manual_seed(0)
    depth = (0.2 * torch.rand(samples, generator=generator)).requires_grad_()
    channels = torch.rand(samples, CHANNELS, generator=generator).requires_grad_()
    ray = torch.arange(samples) // SAMPLES_PER_RAY
    rays = int(ray[-1]) + 1
    run = lambda: kernels.composite(depth, channels, ray, rays)  # noqa: E731
    limit = limits.triad()
    amount = {direction: float(size) * samples for direction, size in COMPOSITE_BYTES.items()}
    return {
        FORWARD: KernelPass(without_gradient(run), amount[FORWARD], limit, "bytes"),
        BOTH: KernelPass(forward_backward(run, [depth, channels]), amount[BOTH], limit, "bytes"),
    }
