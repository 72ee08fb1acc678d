"""Sphere tracing: the first hit and the closest approach of rays to the surface of a signed distance.

Every look-up says how far the surface is, so that a ray may go that far without meeting it (Hart 1996). All rays march
together, without those that are finished. Nothing here is differentiable: the renderer differentiates the result.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import linear, softplus

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedSDF
from invgraphics.core.rays import Rays
from invgraphics.kernels.reference.hash import hash_encode
from invgraphics.kernels.reference.ngp import relu_network
from invgraphics.kernels.types import TracedRays, TracingLimits

Distance = Callable[[Int[Tensor, " k"], Float[Tensor, " k"]], Float[Tensor, " k"]]
"""Signed distance on the rays of these indices, at these distances from their origins."""

GOLDEN = (3 - 5**0.5) / 2
"""Share of the larger part of a bracket at which golden-section search looks next."""
ROUNDING = 1e-6
"""Length, over that of the ray so far, by which a step must exceed its sphere to count as over-relaxed."""

_T, _F, _LOW, _LOW_T, _LOW_A, _LOW_B, _HIT_A, _HIT_FA, _HIT_B, _HIT_FB, _NEXT = range(11)
"""Rows of a march's state: the last accepted look-up, the least one with its neighbours, the bracket of the hit with its
distances, and where to look next."""


@torch.no_grad()
def sphere_trace(distance: Distance, rays: Rays, limits: TracingLimits) -> TracedRays:
    """Trace rays from near to far, or until they are ``limits.depth`` inside.

    Marching goes on behind the first hit: a ray that only grazes a surface leaves it again, and how deep it was decides how
    opaque it is. A hit is bracketed by a change of sign and refined there, so that distances need not be exact.
    """
    state, steps, ended = _march(distance, rays, limits)
    _refine_hits(distance, state, limits)
    _refine_closest(distance, state, limits)
    return result(state, steps, ended, rays, limits)


def result(
    state: Float[Tensor, "11 n"], steps: Int[Tensor, " n"], ended: Bool[Tensor, " n"], rays: Rays, limits: TracingLimits
) -> TracedRays:
    """The result of a trace from the rays' last states; ``ended`` says which were finished before their steps were used up."""
    a, _, b, value = state[_HIT_A : _HIT_FB + 1]
    hit = b.isfinite()
    # A ray that begins inside has no bracket: its hit is where it begins.
    solved = (value.abs() <= limits.tolerance) | (a == b)
    hit_t = torch.where(hit, b, rays.far)
    return TracedRays(hit, hit_t, state[_LOW_T], state[_LOW], steps, torch.where(hit, solved, ended))


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
        # A step ends a ray only as far as its sphere reaches: behind that, an over-relaxed one has to be looked at first.
        looked = state[_T] + state[_F].abs().clamp_min(limits.least)
        done = (state[_F] < -limits.depth) | (looked > far) | (state[_T] >= far)
        state[_NEXT] = torch.minimum(state[_NEXT], far)
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
    relaxed = (jump - safe > ROUNDING * (t + safe)) & (before > 0)
    accepted = ~(relaxed & (value.abs() + before < jump)) | first
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


def _refine_hits(distance: Distance, state: Float[Tensor, "11 n"], limits: TracingLimits) -> None:
    """Move each hit within its bracket to where the distance is 0, by false position (Illinois)."""
    bracket = state[_HIT_A : _HIT_FB + 1]
    unsolved = bracket[2].isfinite() & (bracket[3].abs() > limits.tolerance) & (bracket[0] != bracket[2])
    going = torch.nonzero(unsolved)[:, 0]
    for _ in range(limits.refinements):
        if not len(going):
            break
        a, fa, b, fb = bracket[:, going]
        t = torch.lerp(b, a, fb / (fb - fa))
        value = distance(going, t)
        # The end that stays has its value halved, or one end would stay for ever.
        across = value * fb < 0
        bracket[:, going] = torch.stack([torch.where(across, b, a), torch.where(across, fb, fa / 2), t, value])
        going = going[value.abs() > limits.tolerance]


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


@torch.no_grad()
def sdf_skip(
    rays: Rays, bounds: Bounds, distances: Float[Tensor, "rx ry rz"], margin: float, least: float, factor: float
) -> Float[Tensor, " n"]:
    """See `invgraphics.kernels.sdf_skip`."""
    t, going = rays.near.clone(), torch.nonzero(rays.far > rays.near)[:, 0]
    cells = torch.tensor(distances.shape, device=t.device)
    edges = (bounds.hi - bounds.lo) / cells
    while len(going):
        place = (torch.addcmul(rays.origins[going], t[going, None], rays.directions[going]) - bounds.lo) / edges
        cell = torch.minimum(place.floor().clamp_min(0), cells - 1)
        away = ((place - cell - 0.5) * edges).norm(dim=1)
        free = factor * (distances[tuple(cell.long().unbind(dim=1))] - away) - margin
        moved = t[going] + free
        far = (free > least) & (moved > t[going])
        going, moved = going[far], moved[far]
        t[going] = moved
        going = going[moved < rays.far[going]]
    return torch.minimum(t, rays.far)


def sdf_trace(rays: Rays, bounds: Bounds, field: FusedSDF, limits: TracingLimits) -> TracedRays:
    """See `invgraphics.kernels.sdf_trace`."""

    def distance(index: Int[Tensor, " k"], t: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        return sdf_values(torch.addcmul(rays.origins[index], t[:, None], rays.directions[index]), bounds, field)

    return sphere_trace(distance, rays, limits)


def sdf_values(position: Float[Tensor, "k 3"], bounds: Bounds, field: FusedSDF) -> Float[Tensor, " k"]:
    """See `invgraphics.kernels.sdf_values`."""
    return field.scale * _geometry(bounds.to_unit(position), field, field.net)[:, 0]


@torch.no_grad()
def sdf_radiance(
    position: Float[Tensor, "k 3"], direction: Float[Tensor, "k 3"], bounds: Bounds, field: FusedSDF
) -> Float[Tensor, "k 3"]:
    """See `invgraphics.kernels.sdf_radiance`."""
    colour = field.colour
    assert colour is not None
    unit = bounds.to_unit(position)
    inputs = [_geometry(unit, field, colour.geometry_net)[:, 1:]]
    if colour.grid is not None:
        inputs.append(hash_encode(unit, colour.table, colour.grid)[0])
    if colour.sh_bands:
        inputs.append(harmonics.basis(direction, colour.sh_bands - 1))
    raw = relu_network(colour.net, torch.cat(inputs, dim=1))
    return raw.sigmoid() if colour.colour_space == "srgb" else softplus(raw)


def _geometry(unit: Float[Tensor, "k 3"], field: FusedSDF, net: tuple[tuple[Tensor, Tensor], ...]) -> Float[Tensor, "k outs"]:
    """Outputs of a softplus network of coordinates and encoding."""
    x = torch.cat([(2 * unit - 1) * field.coordinate_scale, _encode(unit, field)], dim=1)
    for weight, bias in net[:-1]:
        x = softplus(linear(x, weight, bias), beta=field.sharpness)
    return linear(x, *net[-1])


def _encode(unit: Float[Tensor, "k 3"], field: FusedSDF) -> Float[Tensor, "k f"]:
    """Features of a grid, or x and the sines and cosines of its octaves."""
    if field.grid is not None:
        return hash_encode(unit, field.table, field.grid)[0]
    x = 2 * unit - 1
    phases = [torch.pi * 2.0**octave * x for octave in range(field.octaves)]
    return torch.cat([x, *(phase.sin() for phase in phases), *(phase.cos() for phase in phases)], dim=1)
