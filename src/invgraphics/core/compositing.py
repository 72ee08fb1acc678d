"""Pictures in front of a background, channel by channel: torch is slow along a last axis of three."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


class _Over(torch.autograd.Function):
    """Differentiable in rgb and alpha."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
        ctx.save_for_backward(background)
        picture, rest = torch.empty_like(rgb), 1 - alpha
        for k in range(3):
            torch.addcmul(rgb[..., k], rest, background[k], out=picture[..., k])
        return picture

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        (gradient,), (background,) = grad_outputs, ctx.saved_tensors
        return gradient, -(gradient @ background), None


def over(
    rgb: Float[Tensor, "*p 3"], alpha: Float[Tensor, "*p"], background: Float[Tensor, 3] | Float[Tensor, "*p 3"]
) -> Float[Tensor, "*p 3"]:
    """``rgb + (1 - alpha) background``, for colour that is premultiplied by alpha; differentiable in all three."""
    plain = background.dim() == 1 and not background.requires_grad and rgb.dtype == alpha.dtype == background.dtype
    if plain:
        picture: Any = _Over.apply(rgb, alpha, background)
        return picture
    return rgb + (1 - alpha[..., None]) * background


def straight_over(
    colour: Float[Tensor, "*p 3"], alpha: Float[Tensor, "*p"], background: Float[Tensor, 3]
) -> Float[Tensor, "*p 3"]:
    """``alpha colour + (1 - alpha) background``, for straight colour. Not differentiable."""
    picture = torch.empty_like(colour)
    for k in range(3):
        torch.lerp(background[k], colour[..., k], alpha, out=picture[..., k])
    return picture
