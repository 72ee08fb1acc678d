"""Sums of Gaussian densities and colours at points, with gradients in the Gaussians; no list of pairs is made."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.field import Gaussians
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.extinction import SMALLEST_DEPTH, reach
from invgraphics.kernels.numba.gaussians.backward import cut_off, spread_colour_gradients
from invgraphics.kernels.numba.gaussians.integrals import STRIDE, seen_colour
from invgraphics.kernels.numba.runtime import array, exp2, inlined, job_start, parallel, prange, threads
from invgraphics.kernels.reference import gaussian_sums as reference

SAME_EYE = np.float32(1e-10)
"""Squared distance of eyes that count as one: they are computed from positions, with their rounding."""
_ZERO, _HALF_LOG2E = np.float32(0.0), np.float32(0.5 / np.log(2.0))


@inlined
def _cell(position, i, origin, edge, shape):
    """Flat index of a point's cell; -1 outside."""
    flat = 0
    for axis in range(3):
        at = int(np.floor((position[i, axis] - origin[axis]) / edge))
        if at < 0 or at >= shape[axis]:
            return -1
        flat = flat * shape[axis] + at
    return flat


@inlined
def _whitened(table, g, position, i):
    """Offset of a point from a Gaussian's centre, also in the frame where the Gaussian is the unit one."""
    cx, cy, cz = position[i, 0] - table[g, 0], position[i, 1] - table[g, 1], position[i, 2] - table[g, 2]
    x = table[g, 3] * cx + table[g, 4] * cy + table[g, 5] * cz
    y = table[g, 6] * cx + table[g, 7] * cy + table[g, 8] * cz
    z = table[g, 9] * cx + table[g, 10] * cy + table[g, 11] * cz
    return (cx, cy, cz), (x, y, z), x * x + y * y + z * z


@inlined
def _same_eye(eye, i, first):
    if i == first:
        return False
    x, y, z = eye[i, 0] - eye[i - 1, 0], eye[i, 1] - eye[i - 1, 1], eye[i, 2] - eye[i - 1, 2]
    return x * x + y * y + z * z < SAME_EYE


@parallel
def density_sums(points, primitives, lists, rooms, sums):
    """Sums of density, and of density times colour where ``sums`` has columns for it."""
    position, eye = points
    table, limit, sh = primitives
    origin, edge, shape, first, entries = lists
    jobs = len(rooms[0])
    for job in prange(jobs):
        basis = np.empty(STRIDE * STRIDE, np.float32)
        stamps, colours, group, start = rooms[0][job, 0], rooms[1][job], np.int32(0), job_start(len(position), jobs, job)
        for i in range(start, job_start(len(position), jobs, job + 1)):
            if len(eye) > 0:
                group += np.int32(not _same_eye(eye, i, start))
            cell = _cell(position, i, origin, edge, shape)
            for k in range(first[cell], first[cell + 1] if cell >= 0 else first[cell]):
                g = entries[k]
                _, _, squared = _whitened(table, g, position, i)
                if squared < limit[g]:
                    density = table[g, 12] * exp2(-_HALF_LOG2E * squared)
                    sums[i, 0] += density
                    if len(eye) > 0:
                        seen_colour(sh, table, g, eye[i], group, stamps, colours, basis)
                        for c in range(3):
                            sums[i, 1 + c] += density * max(colours[g, c], _ZERO)


@parallel
def density_sums_backward(points, primitives, lists, rooms, grad_sums, grads):
    """Gradients of every job in the rows of Gaussians and in their coefficients."""
    position, eye = points
    table, limit, sh = primitives
    origin, edge, shape, first, entries = lists
    jobs = len(rooms[0])
    for job in prange(jobs):
        basis, buffer = np.empty(STRIDE * STRIDE, np.float32), np.empty(STRIDE * STRIDE, np.float32)
        stamps, touched, work = rooms[0][job, 0], rooms[0][job, 1], (rooms[1][job], rooms[2][job])
        grad, grad_sh = grads[0][job], grads[1][job]
        colours, colour_sums = work
        group, count, start = np.int32(0), 0, job_start(len(position), jobs, job)
        end = job_start(len(position), jobs, job + 1)
        for i in range(start, end):
            if len(eye) > 0 and not _same_eye(eye, i, start):
                if count > 0:
                    spread_colour_gradients(sh, table, eye[i - 1], touched, count, work, basis, buffer, grad, grad_sh)
                group, count = group + np.int32(1), 0
            cell = _cell(position, i, origin, edge, shape)
            for k in range(first[cell], first[cell + 1] if cell >= 0 else first[cell]):
                g = entries[k]
                offset, x, squared = _whitened(table, g, position, i)
                if squared >= limit[g]:
                    continue
                response = exp2(-_HALF_LOG2E * squared)
                density, value = table[g, 12] * response, grad_sums[i, 0]
                if len(eye) > 0:
                    if stamps[g] != group:
                        touched[count] = g
                        count += 1
                        seen_colour(sh, table, g, eye[i], group, stamps, colours, basis)
                    for c in range(3):
                        value += grad_sums[i, 1 + c] * max(colours[g, c], _ZERO)
                        colour_sums[g, c] += cut_off(colours[g, c], density * grad_sums[i, 1 + c])
                grad[g, 12] += response * value
                slope = -density * value
                sx, sy, sz = slope * x[0], slope * x[1], slope * x[2]
                for c in range(3):
                    grad[g, c] -= sx * table[g, 3 + c] + sy * table[g, 6 + c] + sz * table[g, 9 + c]
                    grad[g, 3 + c] += sx * offset[c]
                    grad[g, 6 + c] += sy * offset[c]
                    grad[g, 9 + c] += sz * offset[c]
        if count > 0:
            spread_colour_gradients(sh, table, eye[end - 1], touched, count, work, basis, buffer, grad, grad_sh)


class _DensitySums(torch.autograd.Function):
    """Differentiable in rows of Gaussians and coefficients."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, sh: Tensor, points: Any, limit: np.ndarray, lists: Any) -> Tensor:
        jobs, sums = threads(), torch.zeros(len(points[0]), 4 if len(points[1]) else 1)
        rooms = np.zeros((jobs, 1, len(table)), np.int32), np.empty((jobs, len(table), 3), np.float32)
        density_sums(points, (array(table), limit, array(sh)), lists, rooms, sums.numpy())
        ctx.save_for_backward(table, sh)
        ctx.given = points, limit, lists
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        table, sh = ctx.saved_tensors
        points, limit, lists = ctx.given
        jobs, n = threads(), len(table)
        rows, coefficients = torch.zeros(jobs, n, 13), torch.zeros(jobs, *sh.shape)
        rooms = (
            np.zeros((jobs, 2, n), np.int32),
            np.empty((jobs, n, 3), np.float32),
            np.zeros((jobs, n, 3), np.float32),
        )
        given = array(table), limit, array(sh)
        density_sums_backward(points, given, lists, rooms, array(grad_outputs[0]), (rows.numpy(), coefficients.numpy()))
        return rows.sum(dim=0), coefficients.sum(dim=0), None, None, None


def gaussian_density(
    gaussians: Gaussians, position: Float[Tensor, "m 3"], eye: Float[Tensor, "m 3"] | None, smallest: float = SMALLEST_DEPTH
) -> Float[Tensor, "m c"]:
    """See `invgraphics.kernels.gaussians.gaussian_density`; gradients in positions are the reference's."""
    if torch.is_grad_enabled() and (position.requires_grad or (eye is not None and eye.requires_grad)):
        return reference.gaussian_density(gaussians, position, eye, smallest)
    table = reference.density_table(gaussians)
    lists = reference.cell_lists(gaussians, position, smallest)
    if lists is None:
        return (table.sum() * 0).expand(len(position), 1 if eye is None else 4)
    cells = (
        array(lists.origin),
        np.float32(lists.edge),
        array(lists.shape),
        array(lists.first),
        array(lists.entries.to(torch.int32)),
    )
    limit = array(reach(gaussians, "physical", smallest).square())
    points = array(position), np.empty((0, 3), np.float32) if eye is None else array(eye)
    return _DensitySums.apply(table, gaussians.sh, points, limit, cells)
