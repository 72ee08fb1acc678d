"""Tri-planes (EG3D, Chan et al. 2022, arXiv 2112.07945, §3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from typing_extensions import override

from invgraphics.fields.encodings.factors import check_factors
from invgraphics.fields.encodings.lattices import CUBE, LatticeConfig, LatticeFeatures, Place, vertices_along

PLANES = ("xy", "xz", "yz")
"""All three planes of the paper; the published code's are xy, xz and zx, of which two are one."""


@dataclass(frozen=True)
class TriplaneConfig(LatticeConfig):
    """The mean of features on three axis-aligned planes.

    Attributes:
        resolution: vertices along an edge; in a box of other proportions as many voxels in all.
        features: features per vertex (EG3D: 32).
        initial: standard deviation of the normal distribution from which values start; EG3D's come from a generator.
    """

    title: ClassVar[str] = "tri-plane"

    resolution: int = 128
    features: int = 32
    initial: float = 0.1

    def __post_init__(self) -> None:
        check_factors(self.resolution, self.features, self.initial)

    @override
    def build(self, edges: Sequence[float] = CUBE) -> LatticeFeatures:
        """The encoding for a region with these edges; its parameters are ``planes.xy``, ``planes.xz`` and ``planes.yz``."""
        size = dict(zip("xyz", vertices_along(self.resolution, edges), strict=True))
        shapes = {axes: (*(size[axis] for axis in axes), self.features) for axes in PLANES}
        planes = {Place("planes", axes, axes): self.initial * torch.randn(shape) for axes, shape in shapes.items()}
        return LatticeFeatures(planes, "sum", scale=1 / len(PLANES))
