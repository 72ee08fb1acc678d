"""Tile-based front-to-back compositing of footprints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Bins, Footprints

TILE = 16
"""Edge of a tile in pixels (3DGS)."""
EDGE_ON = 1e-6
"""Smallest denominator of a disc's homography: rays parallel to the disc, or that meet it behind the camera, see no disc."""
MISSED = 1e6
"""``q`` where a ray misses a disc."""


@torch.no_grad()
def splat_bin(footprints: Footprints, width: int, height: int, tile: int) -> Bins:
    """See `invgraphics.kernels.splat_bin`."""
    columns, rows = -(-width // tile), -(-height // tile)
    order = torch.argsort(footprints.depths, stable=True)
    splats = order[footprints.radii[order] > 0]

    last = splats.new_tensor([columns - 1, rows - 1])
    centre, radius = footprints.means2d[splats], footprints.radii[splats, None]
    low = torch.minimum(((centre - radius) / tile).floor().long().clamp_min(0), last + 1)
    high = torch.minimum(((centre + radius) / tile).floor().long(), last)
    spans = (high - low + 1).clamp_min(0)

    # One entry per splat and tile it touches, splats front to back; `nth` counts a splat's tiles row by row.
    touched = spans.prod(dim=1)
    entry = torch.repeat_interleave(torch.arange(len(splats), device=splats.device), touched)
    nth = torch.arange(len(entry), device=splats.device) - (touched.cumsum(0) - touched)[entry]
    x, y = low[entry, 0] + nth % spans[entry, 0], low[entry, 1] + nth // spans[entry, 0]
    tile_of = y * columns + x

    # Stable: within a tile the order by depth survives.
    by_tile = torch.argsort(tile_of, stable=True)
    counts = torch.bincount(tile_of, minlength=columns * rows)
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    return Bins(splats[entry[by_tile]], starts, tile, columns, rows)


def splat_rasterise(
    footprints: Footprints,
    features: Float[Tensor, "n c"],
    width: int,
    height: int,
    tile: int | None = None,
    max_grad_splats: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """See `invgraphics.kernels.splat_rasterise`."""
    # Alpha is one more feature, the sum of w * 1.
    columns = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)

    def paint(splats: Int[Tensor, " k"], pixels: Float[Tensor, "p 2"]) -> Float[Tensor, "p c"]:
        return _composite(responses_at(footprints, splats, pixels), columns[splats], max_grad_splats)

    image = over_tiles(footprints, (width, height), tile or TILE, paint)
    return image[..., :-1], image[..., -1]


@torch.no_grad()
def splat_median(footprints: Footprints, width: int, height: int, tile: int | None = None) -> Float[Tensor, "h w"]:
    """See `invgraphics.kernels.splat_median`."""

    def paint(splats: Int[Tensor, " k"], pixels: Float[Tensor, "p 2"]) -> Float[Tensor, "p 1"]:
        after = torch.cumprod(1 - visible_alphas(responses_at(footprints, splats, pixels)), dim=1)
        offset = pixels[:, None] - footprints.means2d[splats]
        distance = footprints.depth_planes[splats, 0] + (offset * footprints.depth_planes[splats, 1:]).sum(dim=2)
        # A last column, which every pixel reaches, stands for those that stay transparent.
        crossed = torch.nn.functional.pad(after <= 0.5, (0, 1), value=True)
        return torch.nn.functional.pad(distance, (0, 1), value=torch.inf).gather(1, crossed.int().argmax(dim=1, keepdim=True))

    return over_tiles(footprints, (width, height), tile or TILE, paint)[..., 0]


def over_tiles(
    footprints: Footprints, size: tuple[int, int], tile: int, paint: Callable[[Tensor, Tensor], Tensor]
) -> Float[Tensor, "h w c"]:
    """Assemble a ``size = (width, height)`` image from ``paint``, called for every tile.

    Args:
        footprints: projected primitives.
        size: width and height in pixels.
        tile: edge of a tile in pixels.
        paint: gets the tile's splats (k,), front to back, and its pixel centres (p, 2); gives (p, c).
    """
    width, height = size
    bins = splat_bin(footprints, width, height, tile)
    starts = bins.starts.tolist()
    rows_of_tiles = []
    for row in range(bins.rows):
        y = torch.arange(row * bins.tile, min((row + 1) * bins.tile, height))
        tiles = []
        for column in range(bins.columns):
            x = torch.arange(column * bins.tile, min((column + 1) * bins.tile, width))
            index = row * bins.columns + column
            splats = bins.splats[starts[index] : starts[index + 1]]
            pixels = torch.cartesian_prod(y, x).flip(dims=(1,)).to(footprints.means2d) + 0.5
            tiles.append(paint(splats, pixels).reshape(len(y), len(x), -1))
        rows_of_tiles.append(torch.cat(tiles, dim=1))
    return torch.cat(rows_of_tiles)


class _GatherAbsolute(torch.autograd.Function):
    """Identity on offsets (p, k, 2) whose backward gives ``probe`` (k, 2) their absolute gradients, summed over pixels."""

    @staticmethod
    def forward(ctx: Any, offset: Tensor, probe: Tensor) -> Tensor:
        return offset.clone()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        return grad_outputs[0], grad_outputs[0].abs().sum(dim=0)


def responses_at(footprints: Footprints, splats: Int[Tensor, " k"], pixels: Float[Tensor, "p 2"]) -> Float[Tensor, "p k"]:
    """``opacity * exp(-q / 2)`` of each splat at each pixel centre."""
    offset = pixels[:, None] - footprints.means2d[splats]
    if footprints.absgrad is not None:
        offset = _GatherAbsolute.apply(offset, footprints.absgrad[splats])
    if footprints.homography is None:
        dx, dy = offset.unbind(dim=2)
        xx, xy, yy = footprints.conics[splats].unbind(dim=1)
        q = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
    else:
        homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1)
        a, b, c = torch.einsum("kij,pj->ipk", footprints.homography[splats], homogeneous)
        hit = c > EDGE_ON
        c = torch.where(hit, c, 1.0)
        q = torch.where(hit, (a * a + b * b) / (c * c), MISSED)
        if footprints.blur is not None:
            q = torch.minimum(q, offset.square().sum(dim=2) / footprints.blur[splats])
    return footprints.opacities[splats] * torch.exp(-0.5 * q)


def visible_alphas(responses: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
    """Alpha of each response: 0 below `ALPHA_MIN`, clamped at `ALPHA_MAX`."""
    return torch.where(responses < ALPHA_MIN, 0.0, responses.clamp_max(ALPHA_MAX))


def _composite(responses: Float[Tensor, "p k"], features: Float[Tensor, "k c"], max_grad_splats: int) -> Float[Tensor, "p c"]:
    """Blend splats front to back: sum over i of T_i alpha_i f_i, T_i = product over j < i of (1 - alpha_j)."""
    alpha = visible_alphas(responses)
    if not max_grad_splats:
        return blending_weights(alpha) @ features
    receives = torch.cumsum(alpha > 0, dim=1) <= max_grad_splats
    weights = blending_weights(torch.where(receives, alpha, alpha.detach()))
    return torch.where(receives, weights, 0.0) @ features + torch.where(receives, 0.0, weights) @ features.detach()


def blending_weights(alpha: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
    """Compositing weights T_i alpha_i; 0 from the splat on that would lower transmittance below `TRANSMITTANCE_MIN`."""
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return torch.where(after < TRANSMITTANCE_MIN, 0.0, alpha * before)
