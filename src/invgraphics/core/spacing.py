"""Coordinates along rays in which strata are equal: distance in a box, distance and then disparity in endless space."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds


def to_spacing(t: Float[Tensor, "*n"], bounds: Bounds, knee: float | Tensor | None = None) -> Float[Tensor, "*n"]:
    """The coordinate in which strata are equal: distance itself in a box.

    In a contracted space, distance up to ``knee`` (by default the box's radius) and disparity beyond it (nerfacto), both
    scaled to run over halves of [0, 1].
    """
    if bounds.space == "box":
        return t
    x = t / (bounds.radius if knee is None else knee)
    return torch.where(x < 1, x / 2, 1 - 1 / (2 * x.clamp_min(1)))


def from_spacing(s: Float[Tensor, "*n"], bounds: Bounds, knee: float | Tensor | None = None) -> Float[Tensor, "*n"]:
    """Inverse of `to_spacing`."""
    if bounds.space == "box":
        return s
    return torch.where(s < 0.5, 2 * s, 1 / (2 * (1 - s.clamp_min(0.5)))) * (bounds.radius if knee is None else knee)
