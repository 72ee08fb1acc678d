"""Compositing of footprints in Triton, forward and backward (definition: `invgraphics.kernels.reference.splat_raster`).

A program owns a tile of pixels and walks through its splats, front to back forward and back to front backward, where each
pixel's transmittance is recovered by division (Kerbl et al. 2023, section 6). One warp per program: the sums over a tile's
pixels, of which the backward pass has nine per splat, then need no shared memory.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels import reference, types
from invgraphics.kernels.cuda.runtime import on_device_of
from invgraphics.kernels.differentiation import once_differentiable

_ALPHA_MIN, _ALPHA_MAX = tl.constexpr(types.ALPHA_MIN), tl.constexpr(types.ALPHA_MAX)
_TRANSMITTANCE_MIN = tl.constexpr(types.TRANSMITTANCE_MIN)

TILE = 8
"""Edge of a tile in pixels by default. With 16 a step takes twice as long (H200, 800 pixels, 300,000 splats)."""
CHANNELS = 3
"""Features that one pass composites; more of them take more passes."""
WARPS = 1
CHUNK = 32
"""Splats between two looks at whether any pixel of the tile still receives light."""


@triton.jit
def _pixels(tile, columns, width, height, TILE: tl.constexpr):
    """Centres of a tile's pixels, their places in the image, and which of them lie in it."""
    lane = tl.arange(0, TILE * TILE)
    column, row = tile % columns * TILE + lane % TILE, tile // columns * TILE + lane // TILE
    return column + 0.5, row + 0.5, row * width + column, (column < width) & (row < height)


@triton.jit
def _response(splat, valid, x, y, means, conics, opacities):
    """Offsets of the pixels from a splat's centre, its conic, its opacity, and its response there."""
    dx, dy = x - tl.load(means + 2 * splat, mask=valid, other=0.0), y - tl.load(means + 2 * splat + 1, mask=valid, other=0.0)
    xx = tl.load(conics + 3 * splat, mask=valid, other=0.0)
    xy = tl.load(conics + 3 * splat + 1, mask=valid, other=0.0)
    yy = tl.load(conics + 3 * splat + 2, mask=valid, other=0.0)
    falloff = tl.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
    return dx, dy, xx, xy, yy, falloff, tl.load(opacities + splat, mask=valid, other=0.0) * falloff


@triton.jit(do_not_specialize=["columns", "width", "height"])
def rasterise(
    means, conics, opacities, features, entries, starts, image, alpha, rest, ends, columns, width, height,
    TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Three features and alpha of a tile's pixels, the transmittance behind them, and the entry after the last one blended."""
    tile = tl.program_id(0)
    x, y, pixel, inside = _pixels(tile, columns, width, height, TILE)
    entry, stop = tl.load(starts + tile), tl.load(starts + tile + 1)
    transmittance = tl.full((TILE * TILE,), 1.0, tl.float32)
    red, green, blue = tl.zeros_like(transmittance), tl.zeros_like(transmittance), tl.zeros_like(transmittance)
    end = tl.zeros((TILE * TILE,), tl.int32)
    receives = inside.to(tl.int32)
    while entry < stop:
        for step in range(CHUNK):
            valid = entry + step < stop
            splat = tl.load(entries + entry + step, mask=valid, other=0).to(tl.int64)
            _, _, _, _, _, _, response = _response(splat, valid, x, y, means, conics, opacities)
            blended = tl.where(response < _ALPHA_MIN, 0.0, tl.minimum(response, _ALPHA_MAX))
            after = transmittance * (1 - blended)
            # Once a splat is refused for too little light, no later one is blended.
            receives = tl.where(after < _TRANSMITTANCE_MIN, 0, receives)
            weight = tl.where(receives > 0, blended * transmittance, 0.0)
            red += weight * tl.load(features + 3 * splat, mask=valid, other=0.0)
            green += weight * tl.load(features + 3 * splat + 1, mask=valid, other=0.0)
            blue += weight * tl.load(features + 3 * splat + 2, mask=valid, other=0.0)
            end = tl.where(weight > 0, entry + step + 1, end)
            transmittance = tl.where(receives > 0, after, transmittance)
        entry += CHUNK
        if tl.max(receives, axis=0) == 0:
            entry = stop
    tl.store(image + 3 * pixel, red, mask=inside)
    tl.store(image + 3 * pixel + 1, green, mask=inside)
    tl.store(image + 3 * pixel + 2, blue, mask=inside)
    tl.store(alpha + pixel, 1 - transmittance, mask=inside)
    tl.store(rest + pixel, transmittance, mask=inside)
    tl.store(ends + pixel, end, mask=inside)


@triton.jit(do_not_specialize=["columns", "width", "height"])
def rasterise_backward(
    means, conics, opacities, features, entries, starts, rest, ends, grad_image, grad_alpha,
    grad_means, grad_conics, grad_opacities, grad_features, absolute, columns, width, height,
    ABSOLUTE: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Gradients of a tile's splats, added atomically; ``absolute`` gets the sums over pixels of |dL/d(means2d)|."""
    tile = tl.program_id(0)
    x, y, pixel, inside = _pixels(tile, columns, width, height, TILE)
    begin = tl.load(starts + tile)
    end = tl.load(ends + pixel, mask=inside, other=0)
    transmittance = tl.load(rest + pixel, mask=inside, other=1.0)
    grad_red = tl.load(grad_image + 3 * pixel, mask=inside, other=0.0)
    grad_green = tl.load(grad_image + 3 * pixel + 1, mask=inside, other=0.0)
    grad_blue = tl.load(grad_image + 3 * pixel + 2, mask=inside, other=0.0)
    grad_opaque = tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    behind = tl.zeros_like(transmittance)  # what the splats behind contribute to the loss, to first order
    entry = tl.max(end, axis=0) - 1
    while entry >= begin:
        splat = tl.load(entries + entry).to(tl.int64)
        dx, dy, xx, xy, yy, falloff, response = _response(splat, True, x, y, means, conics, opacities)
        blends = (entry < end) & (response >= _ALPHA_MIN)
        if tl.max(blends.to(tl.int32), axis=0) > 0:
            blended = tl.where(blends, tl.minimum(response, _ALPHA_MAX), 0.0)
            transmittance = transmittance / (1 - blended)
            value = grad_opaque + tl.load(features + 3 * splat) * grad_red
            value += tl.load(features + 3 * splat + 1) * grad_green + tl.load(features + 3 * splat + 2) * grad_blue
            grad_blended = transmittance * value - behind / (1 - blended)
            weight = blended * transmittance
            behind += weight * value
            tl.atomic_add(grad_features + 3 * splat, tl.sum(weight * grad_red, axis=0))
            tl.atomic_add(grad_features + 3 * splat + 1, tl.sum(weight * grad_green, axis=0))
            tl.atomic_add(grad_features + 3 * splat + 2, tl.sum(weight * grad_blue, axis=0))
            grad_response = tl.where(blends & (response <= _ALPHA_MAX), grad_blended, 0.0)
            grad_q = -0.5 * response * grad_response
            along_x, along_y = -2 * grad_q * (xx * dx + xy * dy), -2 * grad_q * (xy * dx + yy * dy)
            tl.atomic_add(grad_opacities + splat, tl.sum(falloff * grad_response, axis=0))
            tl.atomic_add(grad_conics + 3 * splat, tl.sum(grad_q * dx * dx, axis=0))
            tl.atomic_add(grad_conics + 3 * splat + 1, tl.sum(2 * grad_q * dx * dy, axis=0))
            tl.atomic_add(grad_conics + 3 * splat + 2, tl.sum(grad_q * dy * dy, axis=0))
            tl.atomic_add(grad_means + 2 * splat, tl.sum(along_x, axis=0))
            tl.atomic_add(grad_means + 2 * splat + 1, tl.sum(along_y, axis=0))
            if ABSOLUTE:
                tl.atomic_add(absolute + 2 * splat, tl.sum(tl.abs(along_x), axis=0))
                tl.atomic_add(absolute + 2 * splat + 1, tl.sum(tl.abs(along_y), axis=0))
        entry -= 1


class _Rasterise(torch.autograd.Function):
    """Differentiable in means, conics, opacities and features; the gradient of ``absgrad`` is that of `Footprints.absgrad`."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, absgrad: Tensor | None,
        bins: types.Bins, width: int, height: int,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        splats = tuple(tensor.contiguous() for tensor in (means, conics, opacities, features))
        entries, starts = bins.splats.int(), bins.starts.int()
        image, alpha = means.new_empty(height, width, CHANNELS), means.new_empty(height, width)
        rest, ends = torch.empty_like(alpha), torch.empty_like(alpha, dtype=torch.int32)
        ctx.size = bins.columns, width, height
        ctx.tile, ctx.absolute = bins.tile, absgrad is not None and ctx.needs_input_grad[4]
        with on_device_of(means):
            rasterise[(bins.columns * bins.rows,)](
                *splats, entries, starts, image, alpha, rest, ends, *ctx.size, TILE=bins.tile, CHUNK=CHUNK, num_warps=WARPS
            )
        ctx.save_for_backward(*splats, entries, starts, rest, ends)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        *splats, entries, starts, rest, ends = ctx.saved_tensors
        cotangents = (gradient.contiguous() for gradient in grad_outputs)
        gradients = [torch.zeros_like(tensor) for tensor in splats]
        absolute = torch.zeros_like(splats[0]) if ctx.absolute else splats[0]
        with on_device_of(rest):
            rasterise_backward[(len(starts) - 1,)](
                *splats, entries, starts, rest, ends, *cotangents, *gradients, absolute, *ctx.size,
                ABSOLUTE=ctx.absolute, TILE=ctx.tile, num_warps=WARPS,
            )  # fmt: skip
        return *gradients, absolute if ctx.absolute else None, None, None, None


def splat_rasterise(
    footprints: types.Footprints,
    features: Float[Tensor, "n c"],
    width: int,
    height: int,
    tile: int | None = None,
    max_grad_splats: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """See `invgraphics.kernels.splat_rasterise`.

    Left to the reference: discs, ``max_grad_splats``, tiles whose edge is no power of two from 4 to 32, and absolute gradients
    of more than three features, which no sum over passes gives.
    """
    f, edge, channels = footprints, tile or TILE, features.shape[1]
    several = f.absgrad is not None and channels > CHANNELS
    if f.homography is not None or max_grad_splats or several or edge not in (4, 8, 16, 32):
        return reference.splat_rasterise(footprints, features, width, height, tile, max_grad_splats)
    bins = reference.splat_bin(footprints, width, height, edge)
    padded = torch.nn.functional.pad(features, (0, -channels % CHANNELS))
    passes = [
        _Rasterise.apply(f.means2d, f.conics, f.opacities, three, f.absgrad, bins, width, height)
        for three in padded.split(CHANNELS, dim=1)
    ]
    return torch.cat([image for image, _ in passes], dim=2)[..., :channels], passes[0][1]
