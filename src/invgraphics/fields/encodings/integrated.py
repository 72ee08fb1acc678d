"""Integrated positional encoding (mip-NeRF, Barron et al. 2021, §3.1; mip-NeRF 360, 2022, appendix D)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.fields.encodings.frequency import phases
from invgraphics.fields.encodings.window import Windowed

Basis = Literal["axes", "icosahedron"]


@dataclass(frozen=True)
class IntegratedConfig:
    """Expected sines and cosines of octaves over a sample's Gaussian, along fixed directions.

    Attributes:
        octaves: number of frequencies L; the highest has period 2^(2 - L) of the scene's half-extent.
        basis: directions along which positions are encoded: the three ``axes`` (mip-NeRF), or the 21 of an ``icosahedron``
            whose edges are halved, up to their sign (mip-NeRF 360).
        integrated: whether sines and cosines are averaged over the Gaussian; without, they are those of its mean, for
            comparison.
    """

    title: ClassVar[str] = "integrated encoding"

    octaves: int = 12
    basis: Basis = "axes"
    integrated: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.octaves <= 24:
            raise ValueError(f"octaves must be from 1 to 24 (float32 resolves no more), not {self.octaves}.")

    def build(self) -> IntegratedEncoding:
        """The encoding; it has no parameters."""
        return IntegratedEncoding(self)


class IntegratedEncoding(Windowed):
    """Positional encoding of a Gaussian in the unit cube, mapped to [-1, 1] first.

    Attributes:
        width: ``2 * octaves`` times the number of directions.
        directions: unit vectors of the basis.
    """

    needs_covariance: ClassVar[bool] = True
    directions: Float[Tensor, "b 3"]

    def __init__(self, config: IntegratedConfig) -> None:
        super().__init__(levels=config.octaves, always=1)
        self.config = config
        directions = torch.eye(3) if config.basis == "axes" else icosahedral_basis()
        self.width = 2 * config.octaves * len(directions)
        self.register_buffer("directions", directions, persistent=False)

    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Expected features under N(``unit``, ``covariance``); without a covariance, those of the point.

        Returns:
            All sines, then all cosines, each octave by octave and direction by direction within it.
        """
        directions = self.directions.to(unit.dtype)
        along = (2 * unit - 1) @ directions.T
        spread = None
        if covariance is not None and self.config.integrated:
            outer = (directions[:, :, None] * directions[:, None, :]).flatten(1)
            spread = 4 * (covariance.flatten(1) @ outer.T).clamp_min(0)  # J Σ Jᵀ loses its digits in long far intervals
        features = expected_frequencies(along, spread, self.config.octaves)
        weights = self.level_weights()
        if weights is None:
            return features
        return features * weights.to(features.dtype).repeat_interleave(len(directions)).repeat(2)


def expected_frequencies(
    mean: Float[Tensor, "m b"], variance: Float[Tensor, "m b"] | None, octaves: int
) -> Float[Tensor, "m f"]:
    """E[sin(2^k π x)] and E[cos(2^k π x)] for x ~ N(mean, variance), k = 0 .. octaves - 1 (mip-NeRF, equations 13 and 14).

    Args:
        mean: of b independent coordinates.
        variance: of each; ``None`` for points.
        octaves: number of frequencies.

    Returns:
        All sines, then all cosines, each octave by octave and coordinate by coordinate within it.
    """
    scaled = phases(mean, octaves)
    if variance is None:
        return torch.cat([scaled.sin(), scaled.cos()], dim=1)
    damping = torch.exp(torch.cat([variance * (-0.5 * (torch.pi * 2.0**octave) ** 2) for octave in range(octaves)], dim=1))
    return torch.cat([damping * scaled.sin(), damping * scaled.cos()], dim=1)


def icosahedral_basis() -> Float[Tensor, "21 3"]:
    """Directions of an icosahedron's vertices and edge midpoints, one of each opposite pair: a tight frame.

    It is the once-subdivided geodesic polyhedron of mip-NeRF 360's appendix, in one fixed rotation.
    """
    golden = (1 + 5**0.5) / 2
    signs = [(a, b) for a in (1.0, -1.0) for b in (golden, -golden)]
    corners = [corner for a, b in signs for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))]
    vertices = torch.tensor(corners, dtype=torch.float64)
    # The edges of this icosahedron have length 2.
    edges = [(p, q) for p, q in combinations(vertices.unbind(), 2) if abs(float((p - q).norm()) - 2) < 1e-6]
    points = torch.cat([vertices, torch.stack([(p + q) / 2 for p, q in edges])])
    points = points / points.norm(dim=1, keepdim=True)
    # Of p and -p, the one whose first coordinate that is not zero is positive.
    large = points.abs() > 1e-6
    leading = points.gather(1, large.to(torch.uint8).argmax(dim=1, keepdim=True))[:, 0]
    return points[leading > 0].float()
