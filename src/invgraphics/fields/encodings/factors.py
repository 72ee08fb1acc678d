"""Factors of a voxel grid: vector-matrix and CP decompositions (TensoRF, Chen et al. 2022, arXiv 2203.09517)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from typing_extensions import override

from invgraphics.fields.encodings.lattices import CUBE, LatticeConfig, LatticeFeatures, Place, vertices_along

MODES = (("xy", "z"), ("xz", "y"), ("yz", "x"))
"""Planes of the vector-matrix decomposition, each with the line across it (equation 5)."""


def check_factors(resolution: int, components: int, initial: float) -> None:
    """Check the settings that all factors have.

    Raises:
        ValueError: a size that no lattice has, or a standard deviation of nothing, with which no factor would get a gradient.
    """
    if resolution < 2 or components < 1:
        raise ValueError("resolution must be at least 2, components at least 1.")
    if initial <= 0:
        raise ValueError(f"initial must be above 0, not {initial}: factors of zero stay zero.")


@dataclass(frozen=True)
class VmConfig(LatticeConfig):
    """Products of a plane and the line across it, for each of the three axes (TensoRF-VM, §4.1).

    Attributes:
        resolution: vertices along an edge; in a box of other proportions as many voxels in all.
        components: products of each of the three kinds (TensoRF-VM-192: 16 for density, 48 for colour).
        initial: standard deviation of the normal distribution from which values start.
    """

    title: ClassVar[str] = "vector-matrix factors"

    resolution: int = 128
    components: int = 16
    initial: float = 0.1

    def __post_init__(self) -> None:
        check_factors(self.resolution, self.components, self.initial)

    @override
    def build(self, edges: Sequence[float] = CUBE) -> LatticeFeatures:
        """The encoding for a region with these edges; its parameters are ``planes.xy``, ``lines.z`` and so on."""
        size = dict(zip("xyz", vertices_along(self.resolution, edges), strict=True))
        factors = {}
        for plane, line in MODES:
            for group, axes in (("planes", plane), ("lines", line)):
                shape = *(size[axis] for axis in axes), self.components
                factors[Place(group, axes, axes)] = self.initial * torch.randn(shape)
        return LatticeFeatures(factors, "vm")


@dataclass(frozen=True)
class CpConfig(LatticeConfig):
    """Products of three lines (TensoRF-CP, §3).

    Attributes:
        resolution: vertices along an edge; in a box of other proportions as many voxels in all.
        components: number of products (TensoRF-CP-384: 96 for density, 288 for colour).
        initial: standard deviation of the normal distribution from which values start.
    """

    title: ClassVar[str] = "CP factors"

    resolution: int = 128
    components: int = 96
    initial: float = 0.2

    def __post_init__(self) -> None:
        check_factors(self.resolution, self.components, self.initial)

    @override
    def build(self, edges: Sequence[float] = CUBE) -> LatticeFeatures:
        """The encoding for a region with these edges; its parameters are ``lines.x``, ``lines.y`` and ``lines.z``."""
        sizes = zip("xyz", vertices_along(self.resolution, edges), strict=True)
        lines = {Place("lines", axis, axis): self.initial * torch.randn(size, self.components) for axis, size in sizes}
        return LatticeFeatures(lines, "cp")
