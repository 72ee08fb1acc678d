"""NeRF's positional encoding (Mildenhall et al. 2020, §5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.fields.encodings.window import Windowed

MAX_OCTAVES = 24
"""Octaves of coordinates in [-1, 1] that float32 resolves."""


@dataclass(frozen=True)
class FrequencyConfig:
    """Sines and cosines of octaves of each coordinate.

    Attributes:
        octaves: number of frequencies L; the highest has period 2^(2 - L) of the scene's half-extent.
        include_input: whether the coordinates themselves come first.
    """

    title: ClassVar[str] = "frequency encoding"

    octaves: int = 10
    include_input: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.octaves <= MAX_OCTAVES:
            raise ValueError(f"octaves must be from 0 to {MAX_OCTAVES} (float32 resolves no more), not {self.octaves}.")
        if self.octaves == 0 and not self.include_input:
            raise ValueError("with 0 octaves and include_input = false nothing is left to encode.")

    def build(self) -> FrequencyEncoding:
        """The encoding; it has no parameters."""
        return FrequencyEncoding(self)


class FrequencyEncoding(Windowed):
    """Positional encoding of unit-cube coordinates, mapped to [-1, 1] first.

    Attributes:
        width: ``3 * (2 * octaves + include_input)``.
    """

    def __init__(self, config: FrequencyConfig) -> None:
        super().__init__(levels=config.octaves, always=0 if config.include_input else 1)
        self.config = config
        self.width = frequency_width(config.octaves, config.include_input)

    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features of ``2 * unit - 1``; ``covariance`` is not used."""
        features = frequencies(2 * unit - 1, self.config.octaves, self.config.include_input)
        weights = self.level_weights()
        if weights is None:
            return features
        octaves = weights.to(features.dtype).repeat_interleave(3).repeat(2)
        return features * torch.cat([octaves.new_ones(self.width - len(octaves)), octaves])


def frequency_width(octaves: int, include_input: bool = True) -> int:
    """Number of features that `frequencies` makes of three coordinates."""
    return 3 * (2 * octaves + include_input)


def frequencies(x: Float[Tensor, "m 3"], octaves: int, include_input: bool = True) -> Float[Tensor, "m f"]:
    """``[x, sin(2^k π x), cos(2^k π x)]`` for k = 0 .. octaves - 1 (NeRF, equation 4).

    Returns:
        The input first (if included), then all sines, then all cosines, each octave by octave and x, y, z within it.
    """
    scaled = phases(x, octaves)
    return torch.cat([*([x] if include_input else []), scaled.sin(), scaled.cos()], dim=1)


def phases(x: Float[Tensor, "m b"], octaves: int) -> Float[Tensor, "m f"]:
    """``2^k π x`` for k = 0 .. octaves - 1, octave by octave and coordinate by coordinate within it."""
    if octaves == 0:
        return x[:, :0]
    # One product per octave: to broadcast over rows as short as these takes three times as long.
    return torch.cat([x * (torch.pi * 2.0**octave) for octave in range(octaves)], dim=1)
