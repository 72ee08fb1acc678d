"""`splat_rasterise` as torch sees it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.numba.runtime import GROUP, array, once_differentiable, scratch, split_by_work, threads
from invgraphics.kernels.numba.splat.binning import FEATURES, Packed, pack
from invgraphics.kernels.numba.splat.median import median
from invgraphics.kernels.numba.splat.raster import BLOCK, BLOCKS, EDGE, rasterise
from invgraphics.kernels.numba.splat.raster_backward import OFF, ON, PULLS, gather, walk_back
from invgraphics.kernels.types import Footprints

TILE = EDGE * BLOCK
"""Edge of a tile in pixels, and the largest: the measured best on CPUs (a tile's state fits into the L1 cache)."""


class _Walk(NamedTuple):
    """What the backward pass needs of the forward pass."""

    packed: Packed
    edge: int
    columns: int
    touched: np.ndarray
    ends: np.ndarray
    work: np.ndarray


class _Rasterise(torch.autograd.Function):
    """Differentiable in means2d, conics, opacities and features; `Footprints.absgrad` gets the absolute gradients."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, absgrad: Tensor | None, *constants: Any
    ) -> tuple[Tensor, Tensor]:
        footprints, (width, height), tile, ctx.max_grad_splats = constants
        edge, columns, lines = _tiles(width, height, tile)
        packed = pack(footprints, features, columns, lines, edge * BLOCK)
        image, alpha = means2d.new_empty(height, width, features.shape[1]), means2d.new_empty(height, width)
        ends = np.empty((columns * lines, BLOCKS), np.int32)
        touched, work = np.empty(len(packed.entries), np.uintp), np.empty(columns * lines, np.int64)
        pixels = image.numpy(), alpha.numpy()
        bounds = _bounds(np.diff(packed.starts))
        rasterise(packed.rows, packed.entries, packed.starts, bounds, edge, columns, *pixels, touched, ends, work)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means2d, conics, opacities, features, image, alpha)
        ctx.walk = _Walk(packed, edge, columns, touched, ends, work)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        image_gradient, alpha_gradient = grad_outputs
        means2d, conics, opacities, features, image, alpha = ctx.saved_tensors
        packed, edge, columns, touched, ends, work = ctx.walk
        to_image = array(torch.zeros_like(image) if image_gradient is None else image_gradient)
        to_alpha = array(torch.zeros_like(alpha) if alpha_gradient is None else alpha_gradient)
        bounds = _bounds(work)
        absolute = ctx.needs_input_grad[4]
        rows = packed.rows
        shape = (len(bounds) - 1, len(rows), GROUP + rows.shape[1] - FEATURES - 3)
        sums = scratch("splat sums", int(np.prod(shape))).reshape(shape)
        walk_back(
            rows,
            packed.entries,
            packed.starts,
            bounds,
            edge,
            columns,
            touched,
            ends,
            array(image),
            array(alpha),
            to_image,
            to_alpha,
            sums,
            (np.float32(0),) * (ON if absolute else OFF),
            (np.float32(ctx.max_grad_splats),) * (ON if ctx.max_grad_splats else OFF),
        )
        gradients = tuple(
            torch.zeros_like(x, memory_format=torch.contiguous_format) for x in (means2d, conics, opacities, features)
        )
        pulls = means2d.new_zeros(len(means2d) if absolute else 0, PULLS)
        gather(packed.order, rows, sums, *(gradient.numpy() for gradient in (*gradients, pulls)))
        return (*gradients, pulls if absolute else None, None, None, None, None)


def _tiles(width: int, height: int, tile: int | None) -> tuple[int, int, int]:
    """Blocks along a tile's edge, and the tiles per row and per column."""
    edge = -(-min(tile or TILE, TILE) // BLOCK)
    return edge, -(-width // (edge * BLOCK)), -(-height // (edge * BLOCK))


def _bounds(work: np.ndarray) -> np.ndarray:
    """First tile of each job, such that all have about equal work."""
    jobs = threads()
    bounds = np.empty(jobs + 1, np.int64)
    split_by_work(work, jobs, bounds)
    return bounds


def splat_rasterise(
    footprints: Footprints,
    features: Float[Tensor, "n c"],
    width: int,
    height: int,
    tile: int | None = None,
    max_grad_splats: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """See `invgraphics.kernels.splat_rasterise`; discs are left to the reference."""
    if footprints.homography is not None:
        return reference.splat_rasterise(footprints, features, width, height, tile, max_grad_splats)
    f = footprints
    constants = (footprints, (width, height), tile, max_grad_splats)
    return _Rasterise.apply(f.means2d, f.conics, f.opacities, features, f.absgrad, *constants)


@torch.no_grad()
def splat_median(footprints: Footprints, width: int, height: int, tile: int | None = None) -> Float[Tensor, "h w"]:
    """See `invgraphics.kernels.splat_median`; discs are left to the reference."""
    if footprints.homography is not None:
        return reference.splat_median(footprints, width, height, tile)
    edge, columns, lines = _tiles(width, height, tile)
    packed = pack(footprints, footprints.depth_planes, columns, lines, edge * BLOCK)
    depth = torch.full((height, width), torch.inf)
    bounds, touched = _bounds(np.diff(packed.starts)), np.empty(len(packed.entries), np.uintp)
    median(packed.rows, packed.entries, packed.starts, bounds, edge, columns, touched, depth.numpy())
    return depth
