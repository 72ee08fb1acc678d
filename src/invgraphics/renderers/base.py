"""Normalisation of a pixel's weighted sums to colour, alpha, depth and normal."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import Rendering

MIN_SURFACE_ALPHA = 0.5
"""A pixel with less alpha than this has no depth and no normal (CONVENTIONS.md)."""


def to_rendering(
    rgb: Float[Tensor, "*p 3"],
    alpha: Float[Tensor, "*p"],
    distance: Float[Tensor, "*p"],
    normal: Float[Tensor, "*p 3"] | None,
    far: Float[Tensor, "*p"],
    directions: Float[Tensor, "*p 3"] | None = None,
) -> Rendering:
    """Turn weighted sums into a rendering: depth divided by alpha, normals normalised.

    Args:
        rgb: sum of w * radiance.
        alpha: sum of w.
        distance: sum of w * t.
        normal: sum of w * normal, or ``None``.
        far: depth of pixels with alpha below `MIN_SURFACE_ALPHA`.
        directions: unit ray directions, which tell a normal's front from its back; needed where there are normals.
    """
    seen = alpha >= MIN_SURFACE_ALPHA
    depth = torch.where(seen, distance / alpha.clamp_min(MIN_SURFACE_ALPHA), far)
    if normal is not None:
        assert directions is not None
        unit = normalize(normal, dim=-1)
        unit = torch.where((unit * directions).sum(dim=-1, keepdim=True) > 0, -unit, unit)
        normal = torch.where(seen[..., None], unit, 0.0)
    return Rendering(rgb, alpha, depth, normal)
