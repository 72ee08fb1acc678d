"""Sphere tracing: the first hit and the closest approach of rays to the surface of a signed distance.

Every look-up says how far the surface is, so that a ray may go that far without meeting it (Hart 1996). All rays march
together, without those that are finished. Nothing here is differentiable: `sphere_tracing` differentiates the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core import Rays

Distance = Callable[[Int[Tensor, " k"], Float[Tensor, " k"]], Float[Tensor, " k"]]
"""Signed distance on the rays of these indices, at these distances from their origins."""

GOLDEN = (3 - 5**0.5) / 2
"""Share of the larger part of a bracket at which golden-section search looks next."""


@dataclass(frozen=True)
class TracingLimits:
    """When rays stop, in local length units.

    Attributes:
        steps: most look-ups of a ray while it marches.
        relaxation: factor of a step over the distance, in (0, 2); above 1 it is over-relaxed (Keinert et al. 2014).
        refinements: most look-ups of a ray afterwards, in the bracket of its hit or of its closest approach.
        least: shortest step; surfaces closer together than this along a ray may be missed.
        tolerance: a hit is refined until the distance there is at most this.
        depth: a ray ends where it is this deep inside.
    """

    steps: int
    relaxation: float
    refinements: int
    least: float
    tolerance: float
    depth: float


@dataclass(frozen=True, eq=False)
class Tracing:
    """Where n rays met a surface, or came closest to it.

    Attributes:
        hit: whether the distance changes its sign, or is negative from the start.
        hit_t: distance along the ray of the first such place; ``far`` without one.
        low_t: distance along the ray of the least signed distance.
        low: that signed distance; infinite for rays without an interval.
        steps: look-ups of each ray, refinements left out.
        converged: whether the hit was refined to the tolerance, or a ray without one has left the bounds within its steps.
    """

    hit: Bool[Tensor, " n"]
    hit_t: Float[Tensor, " n"]
    low_t: Float[Tensor, " n"]
    low: Float[Tensor, " n"]
    steps: Int[Tensor, " n"]
    converged: Bool[Tensor, " n"]


_T, _F, _LOW, _LOW_T, _LOW_A, _LOW_B, _HIT_A, _HIT_FA, _HIT_B, _HIT_FB, _NEXT = range(11)
"""Rows of a march's state: the last accepted look-up, the least one with its neighbours, the bracket of the hit with its
distances, and where to look next."""


@torch.no_grad()
def sphere_trace(distance: Distance, rays: Rays, limits: TracingLimits) -> Tracing:
    """Trace rays from near to far, or until they are ``limits.depth`` inside.

    Marching goes on behind the first hit: a ray that only grazes a surface leaves it again, and how deep it was decides how
    opaque it is. A hit is bracketed by a change of sign and refined there, so that distances need not be exact.
    """
    state, steps, ended = _march(distance, rays, limits)
    hit = state[_HIT_B].isfinite()
    solved = _refine_hits(distance, state, limits)
    _refine_closest(distance, state, limits)
    hit_t = torch.where(hit, state[_HIT_B], rays.far)
    return Tracing(hit, hit_t, state[_LOW_T], state[_LOW], steps, torch.where(hit, solved, ended))


def _march(
    distance: Distance, rays: Rays, limits: TracingLimits
) -> tuple[Float[Tensor, "11 n"], Int[Tensor, " n"], Bool[Tensor, " n"]]:
    """States of all rays at their ends, their numbers of look-ups, and whether they ended for another reason than those."""
    n = len(rays)
    whole = rays.near.new_full((_NEXT + 1, n), torch.inf)
    whole[_T] = whole[_LOW_T] = whole[_LOW_A] = whole[_NEXT] = rays.near.detach()
    whole[_F] = 0
    steps = torch.zeros(n, dtype=torch.long, device=whole.device)
    ended = rays.far <= rays.near
    going = torch.nonzero(~ended)[:, 0]
    state, far = whole[:, going], rays.far.detach()[going]
    for count in range(1, limits.steps + 1):
        if not len(going):
            break
        value = distance(going, state[_NEXT])
        _advance(state, value, limits)
        done = (state[_F] < -limits.depth) | (state[_NEXT] > far)
        if count == limits.steps or bool(done.any()):
            finished = done | (count == limits.steps)
            whole[:, going[finished]], steps[going[finished]], ended[going[done]] = state[:, finished], count, True
            left = torch.nonzero(~finished)[:, 0]
            state, far, going = state[:, left], far[left], going[left]
    return whole, steps, ended


def _advance(state: Float[Tensor, "11 k"], value: Float[Tensor, " k"], limits: TracingLimits) -> None:
    """Take the distances ``value`` at the points looked at into the state, and say where to look next."""
    t, before_t, before = state[_NEXT].clone(), state[_T].clone(), state[_F].clone()
    first = state[_LOW].isinf()
    # Two spheres that do not meet may have a surface in between: such a step is taken again, as long as the first sphere only.
    safe = before.abs().clamp_min(limits.least)
    jump = t - before_t
    accepted = ~((jump > safe * (1 + 1e-5)) & (before > 0) & (value.abs() + before < jump)) | first
    crosses = accepted & (value <= 0) & state[_HIT_B].isinf()
    bracket = torch.stack([torch.where(first, t, before_t), torch.where(first, value, before), t, value])
    state[_HIT_A : _HIT_FB + 1] = torch.where(crosses, bracket, state[_HIT_A : _HIT_FB + 1])
    follows = accepted & (state[_LOW_T] == before_t) & ~first
    lower = accepted & (value < state[_LOW])
    state[_LOW_B] = torch.where(lower, t, torch.where(follows, t, state[_LOW_B]))
    closest = torch.stack([value, t, before_t])
    state[_LOW : _LOW_A + 1] = torch.where(lower, closest, state[_LOW : _LOW_A + 1])
    step = torch.where(
        value > 0,
        (limits.relaxation * value).clamp_min(limits.least),
        (-value).clamp_min(max(limits.depth, limits.least)),
    )
    state[_T] = torch.where(accepted, t, before_t)
    state[_F] = torch.where(accepted, value, before)
    state[_NEXT] = torch.where(accepted, t + step, before_t + safe)


def _refine_hits(distance: Distance, state: Float[Tensor, "11 n"], limits: TracingLimits) -> Bool[Tensor, " n"]:
    """Move each hit within its bracket to where the distance is 0, by false position (Illinois); returns which are there."""
    solved = state[_HIT_FB].abs() <= limits.tolerance
    # A ray that begins inside has no bracket: its hit is where it begins.
    solved |= state[_HIT_A] == state[_HIT_B]
    going = torch.nonzero(state[_HIT_B].isfinite() & ~solved)[:, 0]
    a, fa, b, fb = state[_HIT_A : _HIT_FB + 1, going]
    for _ in range(limits.refinements):
        if not len(going):
            break
        t = torch.lerp(b, a, fb / (fb - fa))
        value = distance(going, t)
        # The end that stays has its value halved, or one end would stay for ever.
        across = value * fb < 0
        a, fa = torch.where(across, b, a), torch.where(across, fb, fa / 2)
        b, fb = t, value
        state[_HIT_B, going] = t
        left = torch.nonzero(value.abs() > limits.tolerance)[:, 0]
        solved[going] = value.abs() <= limits.tolerance
        going, a, fa, b, fb = going[left], a[left], fa[left], b[left], fb[left]
    return solved


def _refine_closest(distance: Distance, state: Float[Tensor, "11 n"], limits: TracingLimits) -> None:
    """Move each closest approach that is neither far away nor deep inside to the least distance, by golden sections."""
    low, middle, a, b = state[_LOW], state[_LOW_T], state[_LOW_A], state[_LOW_B]
    going = torch.nonzero((low.abs() < limits.depth) & b.isfinite() & (b > middle) & (middle > a))[:, 0]
    if not len(going):
        return
    f, m, a, b = low[going], middle[going], a[going], b[going]
    for _ in range(limits.refinements):
        t = m + GOLDEN * torch.where(b - m > m - a, b - m, a - m)
        value = distance(going, t)
        lower, beyond = value < f, t > m
        a = torch.where(lower & beyond, m, torch.where(~lower & ~beyond, t, a))
        b = torch.where(lower & ~beyond, m, torch.where(~lower & beyond, t, b))
        f, m = torch.where(lower, value, f), torch.where(lower, t, m)
    state[_LOW, going], state[_LOW_T, going] = f, m
