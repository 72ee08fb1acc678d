"""From a raw value to a volume density: the activation, and whether it comes before or after interpolation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu, softplus

from invgraphics.fields.mlp import truncated_exp

Activation = Literal["softplus", "exp", "relu"]
Interpolation = Literal["post", "in", "pre"]

OPACITY_STEP = 0.5
"""Length over which vertices of ``pre`` have their opacity, in the density's unit of length (DVGO's step, in voxels)."""
_MOST_OPACITY = 1 - 1e-6


@dataclass(frozen=True)
class DensityActivation:
    """Raw values to densities in [0, inf), around the interpolation of a voxel grid (DVGO, Sun et al. 2022, "post-activation").

    Attributes:
        kind: ``exp`` stops growing at exp(15).
        bias: added to raw values first.
        interpolation: ``post``: raw values are interpolated, then activated, which can make a sharp edge inside a voxel.
            ``in``: vertices' densities are interpolated. ``pre``: vertices' opacities over `OPACITY_STEP` are.
    """

    kind: Activation
    bias: float
    interpolation: Interpolation = "post"

    def at_vertices(self, raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Values to interpolate, from raw values at vertices."""
        if self.interpolation == "post":
            return raw
        density = self._activated(raw)
        return density if self.interpolation == "in" else -torch.expm1(-OPACITY_STEP * density)

    def at_points(self, interpolated: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Densities, from values interpolated at points or output by a network."""
        if self.interpolation == "post":
            return self._activated(interpolated)
        if self.interpolation == "in":
            return interpolated
        return -torch.log1p(-interpolated.clamp_max(_MOST_OPACITY)) / OPACITY_STEP

    def _activated(self, raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        activation = {"softplus": softplus, "exp": truncated_exp, "relu": relu}[self.kind]
        return activation(raw + self.bias)
