"""`splat_rasterise` by gsplat's CUDA kernels (Ye et al. 2024): tile intersection and rasterisation to pixels.

Projection stays with the reference: plain torch, a small part of a frame on a GPU, differentiable in the pose, and with the
depth planes that gsplat does not compute. gsplat clamps alpha at 0.999, `invgraphics.kernels.splat_rasterise` at 0.99.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import gsplat
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference
from invgraphics.kernels.types import Footprints

TILE = 16
"""Edge of a tile in pixels (3DGS)."""


def splat_rasterise(
    footprints: Footprints,
    features: Float[Tensor, "n c"],
    width: int,
    height: int,
    tile: int | None = None,
    max_grad_splats: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """See `invgraphics.kernels.splat_rasterise`; discs and ``max_grad_splats`` are left to the reference."""
    f, edge = footprints, tile or TILE
    if f.homography is not None or max_grad_splats or len(f) == 0:
        return reference.splat_rasterise(footprints, features, width, height, tile, max_grad_splats)
    columns, rows = -(-width // edge), -(-height // edge)
    means2d = f.means2d.contiguous()
    # Whole pixels per axis, as gsplat's own projection gives them; 0 where culled.
    radii = f.radii.ceil().int()[:, None].expand(-1, 2)
    with torch.no_grad():
        _, keys, entries = gsplat.isect_tiles(means2d[None], radii[None], f.depths[None], edge, columns, rows)
        starts = gsplat.isect_offset_encode(keys, 1, columns, rows)
    batched = means2d[None]
    image, alpha = gsplat.rasterize_to_pixels(
        batched, f.conics[None], features[None], f.opacities[None], width, height, edge, starts, entries,
        absgrad=f.absgrad is not None,
    )  # fmt: skip
    if f.absgrad is not None and batched.requires_grad:
        _route_absgrad(batched, f.absgrad)
    return image[0], alpha[0, ..., 0]


def _route_absgrad(batched: Float[Tensor, "1 n 2"], absgrad: Float[Tensor, "n 2"]) -> None:
    """Accumulate gsplat's absolute gradients, which its backward leaves at ``batched.absgrad``, into ``absgrad.grad``."""

    def accumulate(_: Tensor) -> None:
        absolute: Tensor = batched.absgrad[0]  # type: ignore[attr-defined]
        absgrad.grad = absolute.clone() if absgrad.grad is None else absgrad.grad + absolute

    batched.register_hook(accumulate)
