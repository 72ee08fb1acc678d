"""A hash grid with two networks, as fields pass it to fused kernels (Instant-NGP, Müller et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

MAX_LEVELS = 64
"""Most levels of a hash grid: between 1 and 2^20 cells along an edge, more would hardly differ."""


@dataclass(frozen=True)
class HashGrid:
    """Geometry of a multi-resolution hash grid (Instant-NGP, §3).

    Level l has ``resolution[l]`` cells along an edge, its vertices are stored densely while they fit into ``2**log2_size``
    entries and are hashed beyond. All levels lie behind one another in one table.

    Attributes:
        levels: number of resolutions.
        features: features per entry.
        log2_size: most entries of a level, as a power of two.
        base: cells along an edge on the coarsest level.
        finest: cells along an edge on the finest level.
    """

    levels: int = 16
    features: int = 2
    log2_size: int = 17
    base: int = 16
    finest: int = 2048

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an edge, per level: a geometric progression from ``base`` to ``finest``."""
        if self.levels == 1:
            return (self.base,)
        growth = np.exp(np.log(self.finest / self.base) / (self.levels - 1))
        return tuple(int(np.floor(self.base * growth**level + 1e-9)) for level in range(self.levels))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Entries per level: all (r+1)^3 vertices, or the hash table's size."""
        return tuple(min((r + 1) ** 3, 2**self.log2_size) for r in self.resolutions)

    @property
    def offsets(self) -> tuple[int, ...]:
        """First entry of each level, and the total at the end."""
        return (0, *(int(total) for total in np.cumsum(self.sizes)))

    @property
    def entries(self) -> int:
        """Entries of the whole table."""
        return self.offsets[-1]


@dataclass(frozen=True, eq=False)
class FusedNGP:
    """Detached parameters of a hash grid with a density and a colour network, for fused inference (Instant-NGP, §5).

    Attributes:
        table: features of all levels.
        grid: geometry of the levels.
        density_net: weight (outs, ins) and bias of each layer of a ReLU network from grid features to the raw density, followed
            by the geometry features for the colour network.
        colour_net: weight and bias of each layer of a ReLU network from geometry features and direction to raw RGB.
        density_activation: maps raw density + ``density_bias`` to density; ``exp`` is clamped at exp(15).
        density_bias: added to the raw density.
        sh_bands: bands of spherical harmonics that encode the direction, 0 to 4.
        colour_space: activation of raw RGB, sigmoid for ``srgb`` and softplus for ``linear``.
        contracted_density: factor of densities in contracted space, besides `Bounds.radial_scale`; 0 for no factor at all.
    """

    table: Float[Tensor, "entries f"]
    grid: HashGrid
    density_net: tuple[tuple[Tensor, Tensor], ...]
    colour_net: tuple[tuple[Tensor, Tensor], ...]
    density_activation: Literal["exp", "softplus", "relu"]
    density_bias: float
    sh_bands: int
    colour_space: Literal["srgb", "linear"]
    contracted_density: float = 0.0


@dataclass(frozen=True, eq=False)
class FusedColour:
    """Detached parameters of the colour of a surface, for fused inference beside a `FusedSDF`.

    Attributes:
        geometry_net: as `FusedSDF.net`, but its outputs are the distance and the geometry features.
        table: features of all levels of an appearance's hash grid; no rows without one.
        grid: geometry of those levels; ``None`` without.
        net: weight (outs, ins) and bias of each layer of a ReLU network from the geometry features, the appearance's and those
            of direction to raw RGB.
        sh_bands: bands of spherical harmonics that encode the direction, 0 to 4.
        colour_space: activation of raw RGB, sigmoid for ``srgb`` and softplus for ``linear``.
    """

    geometry_net: tuple[tuple[Tensor, Tensor], ...]
    table: Float[Tensor, "entries f"]
    grid: HashGrid | None
    net: tuple[tuple[Tensor, Tensor], ...]
    sh_bands: int
    colour_space: Literal["srgb", "linear"]


@dataclass(frozen=True, eq=False)
class FusedSDF:
    """Detached parameters of a signed distance over a hash grid or over octaves, for fused sphere tracing.

    Attributes:
        table: features of all levels; no rows without a grid.
        grid: geometry of the levels; ``None`` where positions are encoded by octaves.
        octaves: sines and cosines of 2^k π x, k = 0 .. octaves - 1 and x the position in the unit cube mapped to [-1, 1],
            behind x itself (NeRF, equation 4); not used with a grid.
        net: weight (outs, ins) and bias of each layer of a softplus network from coordinates, followed by the encoding's
            features, to the distance, which is its one output; layers before the last are activated.
        sharpness: of the softplus.
        coordinate_scale: the network's coordinates over x.
        scale: signed distance in local units over the network's output.
        colour: of its surface; ``None`` where kernels do not support it.
    """

    table: Float[Tensor, "entries f"]
    grid: HashGrid | None
    octaves: int
    net: tuple[tuple[Tensor, Tensor], ...]
    sharpness: float
    coordinate_scale: Float[Tensor, " 3"]
    scale: float
    colour: FusedColour | None = None
