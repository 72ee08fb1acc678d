"""Occupancy-grid ray marching in blocks of steps, plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.types import March, MarchSteps

BLOCK = 64
"""Steps that are tested together, which bounds memory to rays x BLOCK positions."""


@torch.no_grad()
def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """See `invgraphics.kernels.ray_march`.

    The march visits the lattice ``start + k * step``, or with a cone or contracted steps t, t + dt, ... where dt are the
    `step_lengths`; the last interval is cut at ``far``, which must be finite. ``resume`` is the end of the last interval
    tested.
    """
    first = 0
    resume, remaining = start.clone(), torch.full_like(start, steps.limit, dtype=torch.int64)
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    active = torch.nonzero((start < rays.far) & (remaining > 0))[:, 0]
    while len(active):
        edges = _edges(rays[active], start[active], resume[active], (bounds, steps), first)
        first += BLOCK
        t0, t1 = edges[:, :-1], edges[:, 1:]
        unit = bounds.to_unit(rays[active].at((t0 + t1) / 2))
        keep = (t1 > t0) & _look_up(occupied, unit)
        # A ray that reaches its sample limit stops where its last kept interval ends.
        keep &= keep.cumsum(dim=1) <= remaining[active, None]
        row, column = torch.nonzero(keep, as_tuple=True)
        kept.append((active[row], t0[row, column], t1[row, column]))

        remaining[active] -= keep.sum(dim=1)
        last = (keep * torch.arange(1, BLOCK + 1, device=keep.device)).amax(dim=1, keepdim=True)
        resume[active] = torch.where(remaining[active] > 0, edges[:, -1], edges.gather(1, last)[:, 0])
        active = active[(resume[active] < rays.far[active]) & (remaining[active] > 0)]
    return _packed(kept, resume)


def step_lengths(rays: Rays, t: Float[Tensor, " n"], bounds: Bounds, steps: MarchSteps) -> Float[Tensor, " n"]:
    """Lengths of the steps that begin at ``t`` on each ray: ``max(step, cone * t)``, or ``step`` after contraction.

    With x the position and v the direction in half-extents, contraction outside the unit ball scales v's part along x by
    1 / |x|² and the part across it by (2 |x| - 1) / |x|² (the Jacobian of mip-NeRF 360's equation 10).
    """
    if not steps.contracted:
        return (steps.cone * t).clamp_min(steps.step)
    x, y, z = ((rays.at(t) - bounds.centre) / bounds.half).unbind(dim=1)
    u, v, w = (rays.directions / bounds.half).unbind(dim=1)
    squared = (x * x + y * y + z * z).clamp_min(1.0)
    speed, along = u * u + v * v + w * w, x * u + y * v + z * w
    radial, across = along * along / squared, 2 * squared.sqrt() - 1
    scaled = radial + (speed - radial).clamp_min(0.0) * (across * across)
    return torch.where(squared > 1, steps.step * (squared * (speed / scaled).sqrt()), steps.step)


def _edges(
    rays: Rays, start: Float[Tensor, " k"], t: Float[Tensor, " k"], setup: tuple[Bounds, MarchSteps], first: int
) -> Float[Tensor, "k edges"]:
    """The next BLOCK + 1 interval ends of rays that are at ``t`` after ``first`` steps; those beyond ``far`` fall onto it."""
    (bounds, steps), far = setup, rays.far
    if steps.cone == 0 and not steps.contracted:
        # Counted from the start, not added up, so that skipping steps leaves the lattice unchanged.
        count = torch.arange(first, first + BLOCK + 1, dtype=t.dtype, device=t.device)
        return torch.minimum(start[:, None] + count * steps.step, far[:, None])
    edges = [t]
    for _ in range(BLOCK):
        # Without the limit, steps that grow with the distance would overflow behind it.
        t = torch.minimum(t + step_lengths(rays, t, bounds, steps), far)
        edges.append(t)
    return torch.stack(edges, dim=1)


def _look_up(occupied: Bool[Tensor, "r r r"], unit: Float[Tensor, "k b 3"]) -> Bool[Tensor, "k b"]:
    """Whether positions lie in an occupied cell; outside the cube nothing is occupied."""
    resolution = occupied.shape[0]
    inside = ((unit >= 0) & (unit <= 1)).all(dim=-1)
    x, y, z = (unit * resolution).long().clamp(0, resolution - 1).unbind(dim=-1)
    return inside & occupied[x, y, z]


def _packed(kept: list[tuple[Tensor, Tensor, Tensor]], resume: Float[Tensor, " n"]) -> March:
    """Join the blocks' samples, sorted by ray; a stable sort leaves each ray's samples in order of distance."""
    if not kept:
        none = resume.new_zeros(0)
        return March(torch.zeros(0, dtype=torch.int64, device=resume.device), none, none, resume)
    ray, t0, t1 = (torch.cat(parts) for parts in zip(*kept, strict=True))
    order = torch.argsort(ray, stable=True)
    return March(ray[order], t0[order], t1[order], resume)
