"""Light of rays through Gaussians that are composited front to back, differentiable."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.rays import Rays
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.extinction import is_density
from invgraphics.kernels.numba.gaussians.backward import cut_off, place_gradient, spread_colour_gradients
from invgraphics.kernels.numba.gaussians.integrals import STRIDE, optical_depths, seen_colour, shares_origin
from invgraphics.kernels.numba.gaussians.pairs import gaussian_pairs
from invgraphics.kernels.numba.gaussians.shares import normal_distribution
from invgraphics.kernels.numba.runtime import (
    array,
    exp2,
    inlined,
    parallel,
    prange,
    split_by_work,
    threads,
)
from invgraphics.kernels.reference import gaussian_order as reference
from invgraphics.kernels.reference.gaussian_rays import Primitives
from invgraphics.kernels.types import ALPHA_MIN

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_FAINTEST = np.float32(-np.log1p(-ALPHA_MIN))
"""Optical depth of the faintest alpha of a splat that counts."""
_LEAST = np.float32(1e-6)
"""Transmittance behind which nothing is composited."""
_LOG2E = np.float32(1 / np.log(2.0))
_ROOT = np.float32(1 / np.sqrt(2 * np.pi))


@inlined
def _limit(limit, t, sigma):
    """Standardised limit of a ray, the normal distribution function there, and the slope of that: 0 beyond the deviations."""
    z = (limit - t) / sigma
    value, bell = normal_distribution(z)
    return z, value, bell * _ROOT


@inlined
def _keys(table, gaussian, begin, end, o, axes, r, t, keys):
    """What a ray's Gaussians are sorted by: distance of the largest response, or of the centre along an axis."""
    for p in range(begin, end):
        keys[p - begin] = t[p]
        if len(axes) > 0:
            g, a = gaussian[p], r if len(axes) > 1 else 0
            key = _ZERO
            for c in range(3):
                key += (table[g, c] - o[c]) * axes[a, c]
            keys[p - begin] = key


@inlined
def _seen_part(splats, t, sigma, depth, near, far):
    """Share of a Gaussian between near and far; of a splat all or nothing."""
    if splats:
        return _ONE if t > near and depth >= _FAINTEST else _ZERO
    return _limit(far, t, sigma)[1] - _limit(near, t, sigma)[1]


@parallel
def composite_ordered(rays, axes, primitives, readings, pairs, first_ray, kept, sums, rooms):
    """Sums of weight times (1, colour, distance, normal) for every ray; ``kept`` gets what a backward pass needs."""
    origins, directions, near, far = rays
    table, strength, sh, normals = primitives
    reading, splats = readings
    gaussian, starts = pairs
    t, sigma, depth, order = kept
    for job in prange(len(first_ray) - 1):
        basis = np.empty(STRIDE * STRIDE, np.float32)
        stamps, colours, group, keys = rooms[0][job, 0], rooms[1][job], np.int32(0), rooms[2][job]
        for r in range(first_ray[job], first_ray[job + 1]):
            group += np.int32(not shares_origin(origins, r, first_ray[job]))
            begin, end = starts[r], starts[r + 1]
            if begin == end:
                continue
            o, d = origins[r], directions[r]
            optical_depths(table, strength, reading, gaussian, begin, end, o, d, t, sigma, depth)
            _keys(table, gaussian, begin, end, o, axes, r, t, keys)
            order[begin:end] = np.argsort(keys[: end - begin], kind="mergesort") + begin
            through = _ONE
            for k in range(begin, end):
                p = order[k]
                g = gaussian[p]
                tau = depth[p] * _seen_part(splats, t[p], sigma[p], depth[p], near[r], far[r])
                if tau <= _ZERO:
                    continue
                passed = exp2(-tau * _LOG2E)
                weight = through * -np.expm1(-tau)
                through *= passed
                seen_colour(sh, table, g, o, group, stamps, colours, basis)
                sums[r, 0] += weight
                for c in range(3):
                    sums[r, 1 + c] += weight * max(colours[g, c], _ZERO)
                if sums.shape[1] > 4:
                    sums[r, 4] += weight * min(max(t[p], near[r]), far[r])
                if sums.shape[1] > 5:
                    away = normals[g, 0] * d[0] + normals[g, 1] * d[1] + normals[g, 2] * d[2] > _ZERO
                    for c in range(3):
                        sums[r, 5 + c] += -weight * normals[g, c] if away else weight * normals[g, c]
                if through < _LEAST:
                    break


@inlined
def _retrace(splats, kept, begin, end, near, far, taus, before):
    """Optical depths of a ray's Gaussians in order, and the transmittance before each; returns the end of those in sight."""
    t, sigma, depth, order = kept
    through = _ONE
    for k in range(begin, end):
        p = order[k]
        tau = depth[p] * _seen_part(splats, t[p], sigma[p], depth[p], near, far)
        taus[k - begin], before[k - begin] = tau, through
        through *= exp2(-tau * _LOG2E)
        if through < _LEAST:
            return k + 1
    return end


@inlined
def _cut_gradient(splats, t, sigma, depth, near, far, slope):
    """Gradients in distance, width and whole optical depth, given the ``slope`` in the depth between near and far."""
    if splats:
        return _ZERO, _ZERO, slope
    high, above, steep = _limit(far, t, sigma)
    low, below, rise = _limit(near, t, sigma)
    moved = slope * depth / sigma
    # Beyond the deviations the slope is zero, and a limit may be infinite.
    widen = (low * rise if rise > _ZERO else _ZERO) - (high * steep if steep > _ZERO else _ZERO)
    return moved * (rise - steep), moved * widen, slope * (above - below)


@parallel
def composite_ordered_backward(rays, primitives, readings, pairs, first_ray, kept, grad_sums, rooms, grads):
    """Gradients of every job in the rows of Gaussians and in their coefficients, and in each ray's origin and direction."""
    origins, directions, near, far = rays
    table, strength, sh = primitives
    reading, splats = readings
    gaussian, starts = pairs
    t, sigma, depth, order = kept
    for job in prange(len(first_ray) - 1):
        basis, buffer = np.empty(STRIDE * STRIDE, np.float32), np.empty(STRIDE * STRIDE, np.float32)
        stamps, touched, work = rooms[0][job, 0], rooms[0][job, 1], (rooms[1][job], rooms[2][job])
        colours, colour_sums = work
        taus, before = rooms[3][job, 0], rooms[3][job, 1]
        grad, grad_sh = grads[0][job], grads[1][job]
        group, count, by_ray = np.int32(0), 0, len(grads[2]) > 0
        for r in range(first_ray[job], first_ray[job + 1]):
            if by_ray or not shares_origin(origins, r, first_ray[job]):
                if count > 0:
                    spread_colour_gradients(sh, table, origins[r - 1], touched, count, work, basis, buffer, grad, grad_sh)
                group, count = group + np.int32(1), 0
            begin, end = starts[r], starts[r + 1]
            o, d = origins[r], directions[r]
            reached, behind = _retrace(splats, kept, begin, end, near[r], far[r], taus, before), _ZERO
            for k in range(reached - 1, begin - 1, -1):
                p, tau = order[k], taus[k - begin]
                g = gaussian[p]
                if tau <= _ZERO:
                    continue
                if stamps[g] != group:
                    touched[count] = g
                    count += 1
                    seen_colour(sh, table, g, o, group, stamps, colours, basis)
                weight, value = before[k - begin] * -np.expm1(-tau), grad_sums[r, 0]
                for c in range(3):
                    value += grad_sums[r, 1 + c] * max(colours[g, c], _ZERO)
                    colour_sums[g, c] += cut_off(colours[g, c], weight * grad_sums[r, 1 + c])
                slope = value * before[k - begin] * exp2(-tau * _LOG2E) - behind
                behind += weight * value
                found, given = (sigma[p], depth[p]), _cut_gradient(splats, t[p], sigma[p], depth[p], near[r], far[r], slope)
                offset, direction = place_gradient(table, strength, reading, g, o, d, found, given, grad)
                for c in range(3):
                    grad[g, c] += offset[c]
                    grads[3][r, c] += direction[c]
                    if by_ray:
                        grads[2][r, c] -= offset[c]
            if by_ray:
                seen = spread_colour_gradients(sh, table, o, touched, count, work, basis, buffer, grad, grad_sh)
                count = 0
                for c in range(3):
                    grads[2][r, c] -= seen[c]
        if count > 0:
            last = origins[first_ray[job + 1] - 1]
            spread_colour_gradients(sh, table, last, touched, count, work, basis, buffer, grad, grad_sh)


class _Composite(torch.autograd.Function):
    """Differentiable in rows of Gaussians, strengths, coefficients, origins and directions."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, strength: Tensor, sh: Tensor, origins: Tensor, directions: Tensor, settings: Any
    ) -> Tensor:
        pairs, first_ray, limits, axes, normals, readings, width = settings
        p, n, jobs = len(pairs[0]), len(table), len(first_ray) - 1
        sums = torch.zeros(len(origins), width)
        kept = (*(np.empty(p, np.float32) for _ in range(3)), np.empty(p, np.int64))
        most = max(1, int(np.diff(pairs[1]).max(initial=0)))
        rooms = np.zeros((jobs, 1, n), np.int32), np.empty((jobs, n, 3), np.float32), np.empty((jobs, most), np.float32)
        rays = (array(origins), array(directions), *limits)
        given = tuple(array(x) for x in (table, strength, sh, normals))
        composite_ordered(rays, axes, given, readings, pairs, first_ray, kept, sums.numpy(), rooms)
        ctx.save_for_backward(table, strength, sh, origins, directions)
        ctx.given = pairs, first_ray, limits, readings, kept, most
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        table, strength, sh, origins, directions = ctx.saved_tensors
        pairs, first_ray, limits, readings, kept, most = ctx.given
        n, jobs = len(table), len(first_ray) - 1
        rows, coefficients = torch.zeros(jobs, n, 13), torch.zeros(jobs, *sh.shape)
        # Without a row for each ray, gradients of colours are summed over rays of one origin.
        grad_origins = torch.zeros(len(origins) if ctx.needs_input_grad[3] else 0, 3)
        grad_directions = torch.zeros(len(origins), 3)
        rooms = (
            np.zeros((jobs, 2, n), np.int32),
            np.empty((jobs, n, 3), np.float32),
            np.zeros((jobs, n, 3), np.float32),
            np.empty((jobs, 2, most), np.float32),
        )
        composite_ordered_backward(
            (array(origins), array(directions), *limits),
            (array(table), array(strength), array(sh)),
            readings,
            pairs,
            first_ray,
            kept,
            array(grad_outputs[0]),
            rooms,
            tuple(x.numpy() for x in (rows, coefficients, grad_origins, grad_directions)),
        )
        summed = rows.sum(dim=0)
        moved = grad_origins if len(grad_origins) else None
        return summed[:, :12], summed[:, 12], coefficients.sum(dim=0), moved, grad_directions, None


def gaussian_composites(primitives: Primitives, rays: Rays, axes: reference.Axes, extra: int = 0) -> Float[Tensor, "n c"]:
    """See `invgraphics.kernels.gaussians.gaussian_composites`; gradients of distances and normals are the reference's."""
    if extra and torch.is_grad_enabled():
        return reference.gaussian_composites(primitives, rays, axes, extra)
    ray, gaussian = gaussian_pairs(primitives, rays)
    starts = np.zeros(len(rays) + 1, np.int64)
    np.cumsum(np.bincount(ray.numpy(), minlength=len(rays)), out=starts[1:])
    first_ray = np.empty(threads() + 1, np.int64)
    split_by_work(np.diff(starts), threads(), first_ray)
    splats = primitives.opacity == "splat"
    settings = (
        (gaussian.numpy(), starts),
        first_ray,
        (array(rays.near), array(rays.far)),
        np.empty((0, 3), np.float32) if axes is None else array(axes).reshape(-1, 3),
        primitives.normals,
        ((is_density(primitives.opacity), primitives.self_attenuation and not splats), splats),
        4 + extra,
    )
    table = torch.cat([primitives.means, primitives.whitening.flatten(1)], dim=1)
    return _Composite.apply(table, primitives.strength, primitives.sh, rays.origins, rays.directions, settings)
