"""`splat_rasterise` and `splat_median` as torch functions: bin, rasterise to pixels, backward."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.differentiation import once_differentiable
from invgraphics.kernels.numba.runtime import GROUP, array, scratch, split_by_work, threads
from invgraphics.kernels.numba.splat.binning import FEATURES, Packed, pack_and_intersect
from invgraphics.kernels.numba.splat.median import median
from invgraphics.kernels.numba.splat.raster import BLOCK, BLOCKS, EDGE, rasterise
from invgraphics.kernels.numba.splat.raster_backward import ABSGRADS, OFF, ON, rasterise_backward, reduce_gradients
from invgraphics.kernels.types import Footprints

TILE = EDGE * BLOCK
"""Default and maximum edge of a tile in pixels: the measured optimum on CPUs (a tile's state fits into the L1 cache)."""


class _TileState(NamedTuple):
    """Tile lists and block masks that the forward pass saves for the backward pass."""

    packed: Packed
    edge: int
    columns: int
    touched: np.ndarray
    last_entries: np.ndarray
    work: np.ndarray


class _Rasterise(torch.autograd.Function):
    """Differentiable in means2d, conics, opacities and features; `Footprints.absgrad` gets the absolute gradients."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, absgrad: Tensor | None, *constants: Any
    ) -> tuple[Tensor, Tensor]:
        footprints, (width, height), tile, ctx.max_grad_splats = constants
        edge, columns, tile_rows = _tiles(width, height, tile)
        packed = pack_and_intersect(footprints, features, columns, tile_rows, edge * BLOCK)
        image, alpha = means2d.new_empty(height, width, features.shape[1]), means2d.new_empty(height, width)
        last_entries = np.empty((columns * tile_rows, BLOCKS), np.int32)
        touched, work = np.empty(len(packed.entries), np.uintp), np.empty(columns * tile_rows, np.int64)
        pixels = image.numpy(), alpha.numpy()
        bounds = _bounds(np.diff(packed.starts))
        rasterise(packed.rows, packed.entries, packed.starts, bounds, edge, columns, *pixels, touched, last_entries, work)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means2d, conics, opacities, features, image, alpha)
        ctx.tile_state = _TileState(packed, edge, columns, touched, last_entries, work)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        grad_image, grad_alpha = grad_outputs
        means2d, conics, opacities, features, image, alpha = ctx.saved_tensors
        packed, edge, columns, touched, last_entries, work = ctx.tile_state
        image_cotangent = array(torch.zeros_like(image) if grad_image is None else grad_image)
        alpha_cotangent = array(torch.zeros_like(alpha) if grad_alpha is None else grad_alpha)
        bounds = _bounds(work)
        wants_absgrad = ctx.needs_input_grad[4]
        rows = packed.rows
        shape = (len(bounds) - 1, len(rows), GROUP + rows.shape[1] - FEATURES - 3)
        sums = scratch("splat sums", int(np.prod(shape))).reshape(shape)
        rasterise_backward(
            rows,
            packed.entries,
            packed.starts,
            bounds,
            edge,
            columns,
            touched,
            last_entries,
            array(image),
            array(alpha),
            image_cotangent,
            alpha_cotangent,
            sums,
            (np.float32(0),) * (ON if wants_absgrad else OFF),
            (np.float32(ctx.max_grad_splats),) * (ON if ctx.max_grad_splats else OFF),
        )
        gradients = tuple(
            torch.zeros_like(x, memory_format=torch.contiguous_format) for x in (means2d, conics, opacities, features)
        )
        absgrads = means2d.new_zeros(len(means2d) if wants_absgrad else 0, ABSGRADS)
        reduce_gradients(packed.order, rows, sums, *(gradient.numpy() for gradient in (*gradients, absgrads)))
        return (*gradients, absgrads if wants_absgrad else None, None, None, None, None)


def _tiles(width: int, height: int, tile: int | None) -> tuple[int, int, int]:
    """Blocks along a tile's edge, and numbers of tiles in x and in y."""
    edge = -(-min(tile or TILE, TILE) // BLOCK)
    return edge, -(-width // (edge * BLOCK)), -(-height // (edge * BLOCK))


def _bounds(work: np.ndarray) -> np.ndarray:
    """First tile of each job, balanced by work."""
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
    edge, columns, tile_rows = _tiles(width, height, tile)
    packed = pack_and_intersect(footprints, footprints.depth_planes, columns, tile_rows, edge * BLOCK)
    depth = torch.full((height, width), torch.inf)
    bounds, touched = _bounds(np.diff(packed.starts)), np.empty(len(packed.entries), np.uintp)
    median(packed.rows, packed.entries, packed.starts, bounds, edge, columns, touched, depth.numpy())
    return depth
