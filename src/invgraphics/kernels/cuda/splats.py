"""`splat_rasterise` by gsplat (Ye et al. 2024), whose CUDA kernels sort footprints into tiles and blend them.

Projection stays with the reference: plain torch, a small part of a frame on a GPU, differentiable in the pose and able to say
at which distance a footprint responds. gsplat clamps alpha at 0.999 where `invgraphics.kernels.splat_rasterise` says 0.99.
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
    receivers: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """See `invgraphics.kernels.splat_rasterise`; discs and limited receivers are left to the reference."""
    f, edge = footprints, tile or TILE
    if f.homography is not None or receivers or len(f) == 0:
        return reference.splat_rasterise(footprints, features, width, height, tile, receivers)
    columns, rows = -(-width // edge), -(-height // edge)
    means2d = f.means2d.contiguous()
    # Whole pixels per axis, as gsplat's own projection gives them; 0 where culled.
    reach = f.radii.ceil().int()[:, None].expand(-1, 2)
    with torch.no_grad():
        _, keys, entries = gsplat.isect_tiles(means2d[None], reach[None], f.depths[None], edge, columns, rows)
        starts = gsplat.isect_offset_encode(keys, 1, columns, rows)
    batched = means2d[None]
    image, alpha = gsplat.rasterize_to_pixels(
        batched, f.conics[None], features[None], f.opacities[None], width, height, edge, starts, entries,
        absgrad=f.pull is not None,
    )  # fmt: skip
    if f.pull is not None and batched.requires_grad:
        _hand_over(batched, f.pull)
    return image[0], alpha[0, ..., 0]


def _hand_over(batched: Float[Tensor, "1 n 2"], pull: Float[Tensor, "n 2"]) -> None:
    """Once gsplat has left its sums of absolute gradients at ``batched``, make them the gradient of ``pull``."""

    def keep(_: Tensor) -> None:
        absolute: Tensor = batched.absgrad[0]  # type: ignore[attr-defined]
        pull.grad = absolute.clone() if pull.grad is None else pull.grad + absolute

    batched.register_hook(keep)
