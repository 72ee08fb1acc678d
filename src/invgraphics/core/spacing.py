"""Coordinates along rays in which strata are equal: distance in a box, distance and then disparity in endless space."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds


def to_spacing(t: Float[Tensor, "*n"], bounds: Bounds, transition: float | Tensor | None = None) -> Float[Tensor, "*n"]:
    """Map ray distances to the spacing coordinate in which strata are equal: in a box, distance itself.

    In a contracted space, spacing is linear in distance up to ``transition`` and in disparity beyond it, and each part fills
    half of [0, 1] (nerfacto's ``UniformLinDispPiecewiseSampler``).

    Args:
        t: distances along rays.
        bounds: in whose space rays run.
        transition: distance at which linear spacing turns into disparity; by default the box's radius.
    """
    if bounds.space == "box":
        return t
    x = t / (bounds.radius if transition is None else transition)
    return torch.where(x < 1, x / 2, 1 - 1 / (2 * x.clamp_min(1)))


def from_spacing(s: Float[Tensor, "*n"], bounds: Bounds, transition: float | Tensor | None = None) -> Float[Tensor, "*n"]:
    """Inverse of `to_spacing`."""
    if bounds.space == "box":
        return s
    return torch.where(s < 0.5, 2 * s, 1 / (2 * (1 - s.clamp_min(0.5)))) * (bounds.radius if transition is None else transition)
