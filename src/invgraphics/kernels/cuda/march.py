"""Occupancy-grid ray marching in Triton, one ray per lane (definition: `invgraphics.kernels.reference.march`).

Rays are marched twice: once to count what they keep, once to write it where the counts before have left room.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.cuda.runtime import blocks, on_device_of
from invgraphics.kernels.types import March, MarchSteps

BLOCK = 32
"""Rays per program: a warp marches until its last ray ends."""


@triton.jit
def _step_length(x, y, z, u, v, w, t, step, cone, CONTRACTED: tl.constexpr):
    """Length of the step at ``t`` (see `reference.march.step_lengths`); position and direction in half-extents."""
    if CONTRACTED:
        squared = tl.maximum(x * x + y * y + z * z, 1.0)
        along = x * u + y * v + z * w
        radial = along * along / squared
        speed = u * u + v * v + w * w
        across = 2 * tl.sqrt(squared) - 1
        scaled = radial + tl.maximum(speed - radial, 0.0) * (across * across)
        length = tl.where(squared > 1, step * (squared * tl.sqrt(speed / scaled)), step)
    else:
        length = tl.maximum(cone * t, step)
    return length


@triton.jit
def _contracted(x, y, z):
    """Contraction of all space to the ball of radius 2 (mip-NeRF 360, equation 10)."""
    norm = tl.sqrt(tl.maximum(x * x + y * y + z * z, 1.0))
    scale = tl.where(norm > 1, (2 - 1 / norm) / norm, 1.0)
    return x * scale, y * scale, z * scale


@triton.jit(do_not_specialize=["n"])
def march(
    origins, directions, far, start, occupied, box, first, ray_of, t0_of, t1_of, counts, resume,
    n, edge, limit, step, cone,
    EVEN: tl.constexpr, BALL: tl.constexpr, CONTRACTED: tl.constexpr, WRITE: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Count the intervals of a block of rays, or write them from ``first`` on. ``box`` holds centre and half-extents."""
    i = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    valid = i < n
    hx, hy, hz = tl.load(box + 3), tl.load(box + 4), tl.load(box + 5)
    ox = (tl.load(origins + 3 * i, mask=valid, other=0.0) - tl.load(box)) / hx
    oy = (tl.load(origins + 3 * i + 1, mask=valid, other=0.0) - tl.load(box + 1)) / hy
    oz = (tl.load(origins + 3 * i + 2, mask=valid, other=0.0) - tl.load(box + 2)) / hz
    dx = tl.load(directions + 3 * i, mask=valid, other=0.0) / hx
    dy = tl.load(directions + 3 * i + 1, mask=valid, other=0.0) / hy
    dz = tl.load(directions + 3 * i + 2, mask=valid, other=1.0) / hz
    begin, end = tl.load(start + i, mask=valid, other=0.0), tl.load(far + i, mask=valid, other=0.0)
    to = tl.load(first + i, mask=valid, other=0)
    t0, tested = begin, begin
    kept, count = tl.zeros((SIZE,), tl.int32), 0
    going = (valid & (begin < end) & (limit > 0)).to(tl.int32)
    while tl.max(going, axis=0) > 0:
        if EVEN:
            # Counted from the start, not added up, so that skipping steps leaves the lattice unchanged.
            t0, t1 = tl.minimum(begin + count * step, end), tl.minimum(begin + (count + 1) * step, end)
        else:
            length = _step_length(ox + t0 * dx, oy + t0 * dy, oz + t0 * dz, dx, dy, dz, t0, step, cone, CONTRACTED)
            t1 = tl.minimum(t0 + length, end)
        middle = (t0 + t1) / 2
        x, y, z = ox + middle * dx, oy + middle * dy, oz + middle * dz
        if BALL:
            x, y, z = _contracted(x, y, z)
            x, y, z = x / 2, y / 2, z / 2
        x, y, z = (x + 1) / 2, (y + 1) / 2, (z + 1) / 2
        inside = (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1) & (z >= 0) & (z <= 1) & (going > 0) & (t1 > t0)
        cx = tl.minimum(tl.maximum((x * edge).to(tl.int32), 0), edge - 1)
        cy = tl.minimum(tl.maximum((y * edge).to(tl.int32), 0), edge - 1)
        cz = tl.minimum(tl.maximum((z * edge).to(tl.int32), 0), edge - 1)
        keep = inside & (tl.load(occupied + (cx * edge + cy) * edge + cz, mask=inside, other=0) != 0)
        if WRITE:
            tl.store(ray_of + to + kept, i, mask=keep)
            tl.store(t0_of + to + kept, t0, mask=keep)
            tl.store(t1_of + to + kept, t1, mask=keep)
        kept += keep.to(tl.int32)
        tested = tl.where(going > 0, t1, tested)
        going = tl.where((t1 >= end) | (kept >= limit), 0, going)
        t0 = t1
        count += 1
    tl.store(counts + i, kept, mask=valid)
    tl.store(resume + i, tested, mask=valid)


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`."""
    n = len(rays)
    box = torch.cat([bounds.centre, bounds.half]).to(start)
    inputs = [tensor.contiguous() for tensor in (rays.origins, rays.directions, rays.far, start)]
    cells = occupied.contiguous().view(torch.uint8)
    counts, resume = torch.zeros(n, dtype=torch.int32, device=start.device), start.clone()
    first = torch.zeros(n + 1, dtype=torch.int64, device=start.device)
    sizes = n, occupied.shape[0], steps.limit, float(steps.step), float(steps.cone)
    flags = {"EVEN": steps.cone == 0 and not steps.contracted, "BALL": bounds.space == "contracted"}
    flags |= {"CONTRACTED": steps.contracted, "SIZE": BLOCK}

    def run(ray: Tensor, t0: Tensor, t1: Tensor, write: bool) -> None:
        if n:
            with on_device_of(start):
                outputs = first, ray, t0, t1, counts, resume
                march[(blocks(n, BLOCK),)](*inputs, cells, box, *outputs, *sizes, WRITE=write, num_warps=1, **flags)

    run(first, start, start, False)
    torch.cumsum(counts, 0, out=first[1:])
    total = int(first[-1])
    ray = torch.empty(total, dtype=torch.int64, device=start.device)
    t0, t1 = start.new_empty(total), start.new_empty(total)
    run(ray, t0, t1, True)
    return March(ray, t0, t1, resume)
