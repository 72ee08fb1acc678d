"""Light of rays through overlapping Gaussians, differentiable: memory, jobs and torch around the compiled loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.rays import Rays
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.extinction import is_density
from invgraphics.kernels.numba.gaussians.backward import integrate_backward
from invgraphics.kernels.numba.gaussians.integrals import integrate
from invgraphics.kernels.numba.gaussians.nodes import COUNT, PASSES
from invgraphics.kernels.numba.gaussians.pairs import gaussian_pairs
from invgraphics.kernels.numba.gaussians.shares import ROWS
from invgraphics.kernels.numba.runtime import GROUP, array, scratch, split_by_work, threads
from invgraphics.kernels.reference import gaussian_quadrature as reference
from invgraphics.kernels.reference.gaussian_rays import Primitives


def whole_registers(count: int) -> int:
    """Round a count up to whole SIMD registers."""
    return -(-count // GROUP) * GROUP


class _Work:
    """Pairs of one call, how its rays are split into jobs, and the jobs' work arrays.

    Attributes:
        pairs: index of each pair's Gaussian, and the first pair of each ray.
        first_ray: of each job, and the number of rays.
    """

    def __init__(self, gaussian: np.ndarray, starts: np.ndarray) -> None:
        self.pairs = gaussian, starts
        counts, jobs = np.diff(starts), threads()
        self.first_ray = np.empty(jobs + 1, np.int64)
        split_by_work(counts, jobs, self.first_ray)
        self.most = max(1, int(counts.max(initial=0)))

    def rooms(self, width: int) -> tuple[np.ndarray, ...]:
        """Shares of each Gaussian in intervals, the first and last registers of these, and rows of light."""
        jobs, most = len(self.first_ray) - 1, self.most
        shapes = (jobs, most, ROWS * width), (jobs, 5, width)
        shares, light = (
            scratch(f"gaussians.{i}", int(np.prod(shape)))[: int(np.prod(shape))].reshape(shape)
            for i, shape in enumerate(shapes)
        )
        limits = scratch("gaussians.limits", 2 * jobs * most, np.uintp)[: 2 * jobs * most].reshape(jobs, most, 2)
        return shares, limits, light

    def sorting(self) -> tuple[np.ndarray, np.ndarray]:
        """Arrays in which quadrature nodes are placed."""
        jobs, most = len(self.first_ray) - 1, whole_registers(COUNT * self.most)
        size = 6 * most
        rows = scratch("gaussians.nodes", jobs * size)[: jobs * size].reshape(jobs, 6, most)
        return rows, np.empty((jobs, PASSES, 256), np.int32)

    def colours(self, gaussians: int, columns: int) -> tuple[np.ndarray, ...]:
        """``columns`` arrays of zeros, one entry per Gaussian, and room for their colours."""
        jobs = len(self.first_ray) - 1
        size = 3 * jobs * gaussians
        return np.zeros((jobs, columns, gaussians), np.int32), scratch("gaussians.colours", size)[:size].reshape(jobs, -1, 3)


class _Integrate(torch.autograd.Function):
    """Differentiable in rows of Gaussians, strengths, coefficients, origins and directions."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, strength: Tensor, sh: Tensor, origins: Tensor, directions: Tensor, settings: Any
    ) -> Tensor:
        work, limits, normals, reading, steps, width = settings
        rays, p = len(origins), len(work.pairs[0])
        sums = torch.zeros(rays, width)
        kept = (
            *(np.empty(p, np.float32) for _ in range(3)),
            np.empty((rays, whole_registers(steps) + 1), np.float32),
            np.empty(rays, np.float32),
        )
        given = tuple(array(x) for x in (table, strength, sh, normals))
        along = (array(origins), array(directions), *(array(x) for x in limits))
        stamps, colours = work.colours(len(table), 1)
        rooms = (*work.rooms(whole_registers(steps)), *work.sorting(), stamps[:, 0], colours)
        integrate(along, given, reading, work.pairs, work.first_ray, steps, kept, sums.numpy(), rooms)
        ctx.save_for_backward(table, strength, sh, origins, directions)
        ctx.work, ctx.kept, ctx.reading = work, kept, reading
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        table, strength, sh, origins, directions = ctx.saved_tensors
        work, width = ctx.work, ctx.kept[3].shape[1] - 1
        jobs = len(work.first_ray) - 1
        rows, coefficients = torch.zeros(jobs, len(table), 13), torch.zeros(jobs, *sh.shape)
        # Without a row for each ray, gradients of colours are summed over rays of one origin.
        grad_origins = torch.zeros(len(origins) if ctx.needs_input_grad[3] else 0, 3)
        grad_directions = torch.zeros(len(origins), 3)
        colour_sums = np.zeros((jobs, len(table), 3), np.float32)
        rooms = *work.rooms(width), np.empty((jobs, 2, work.most), np.float32), *work.colours(len(table), 2), colour_sums
        integrate_backward(
            (array(origins), array(directions)),
            (array(table), array(strength), array(sh)),
            ctx.reading,
            work.pairs,
            work.first_ray,
            ctx.kept,
            array(grad_outputs[0]),
            rooms,
            tuple(x.numpy() for x in (rows, coefficients, grad_origins, grad_directions)),
        )
        summed = rows.sum(dim=0)
        moved = grad_origins if len(grad_origins) else None
        return summed[:, :12], summed[:, 12], coefficients.sum(dim=0), moved, grad_directions, None


def gaussian_integrals(primitives: Primitives, rays: Rays, steps: int, extra: int = 0) -> Float[Tensor, "n c"]:
    """See `invgraphics.kernels.gaussians.gaussian_integrals`; gradients of distances and normals are the reference's."""
    if primitives.opacity == "splat" or (extra and torch.is_grad_enabled()):
        return reference.gaussian_integrals(primitives, rays, steps, extra)
    ray, gaussian = gaussian_pairs(primitives, rays)
    starts = np.zeros(len(rays) + 1, np.int64)
    np.cumsum(np.bincount(ray.numpy(), minlength=len(rays)), out=starts[1:])
    table = torch.cat([primitives.means, primitives.whitening.flatten(1)], dim=1)
    settings = (
        _Work(gaussian.numpy(), starts),
        (rays.near, rays.far),
        primitives.normals,
        (is_density(primitives.opacity), primitives.self_attenuation),
        steps,
        4 + extra,
    )
    return _Integrate.apply(table, primitives.strength, primitives.sh, rays.origins, rays.directions, settings)
