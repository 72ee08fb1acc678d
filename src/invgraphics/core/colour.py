"""Colour spaces: linear Rec. 709 and display sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def linear_to_srgb(linear: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """The sRGB opto-electronic transfer function; input is clipped to [0, 1]."""
    linear = linear.clamp(0, 1)
    curve = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def srgb_to_linear(srgb: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """Inverse of `linear_to_srgb`; input is clipped to [0, 1]."""
    srgb = srgb.clamp(0, 1)
    curve = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, curve)


def quantise(values: Float[Tensor, "*p"]) -> UInt8[Tensor, "*p"]:
    """Clip to [0, 1] and round to bytes."""
    return (values.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
