"""Compositing: pictures over a background, and alphas, weights and optical depths along a ray from each other.

Pictures are composited channel by channel: torch is slow along a last axis of three.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

MIN_TRANSMITTANCE = 1e-6
"""Transmittance below which alpha = w / T is dominated by rounding."""


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


def alphas_from_weights(weight: Float[Tensor, " k"]) -> tuple[Float[Tensor, " k"], Float[Tensor, " k_plus_1"]]:
    """Alphas w_i / T_i of a ray's samples from their weights; and the transmittance T before each and at the end."""
    reached = 1 - pad(weight.double().cumsum(0), (1, 0))
    alpha = (weight / reached[:-1].clamp_min(MIN_TRANSMITTANCE)).clamp(0, 1)
    return alpha.to(weight.dtype), reached.clamp(0, 1).to(weight.dtype)


def weights_from_alphas(alpha: Float[Tensor, "p h w"]) -> Float[Tensor, "p h w"]:
    """Weights T_i α_i of layers, nearest first, with T_i = Π_{j<i} (1 - α_j)."""
    light, weights = torch.ones_like(alpha[0]), []
    for layer in alpha.unbind(0):
        weights.append(light * layer)
        light = light - weights[-1]
    return torch.stack(weights)


def layer_alphas_from_weights(weights: Float[Tensor, "p h w"]) -> Float[Tensor, "p h w"]:
    """Alphas of layers, nearest first, from their weights, whose sum is at most 1; the inverse of `weights_from_alphas`.

    In the weights' own precision, as layers fill the memory; `alphas_from_weights` is for the samples of one ray.
    """
    before = weights.cumsum(dim=0) - weights
    return (weights / (1 - before).clamp_min(MIN_TRANSMITTANCE)).clamp(0, 1)


def optical_depth_before(optical_depth: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Optical depth in front of each of a ray's consecutive intervals."""
    return pad(optical_depth[:, :-1].cumsum(dim=1), (1, 0))


def weights_from_optical_depth(optical_depth: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Weights T_i α_i of a ray's consecutive intervals from their optical depths (NeRF, equation 3)."""
    return torch.exp(-optical_depth_before(optical_depth)) * -torch.expm1(-optical_depth)
