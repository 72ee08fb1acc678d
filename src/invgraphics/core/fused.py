"""A field over lattices, as fields pass it to fused kernels: voxels, tri-planes and factors, with networks or without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.lattice import Combination, Lattice

Layers = tuple[tuple[Float[Tensor, "outs ins"], Float[Tensor, " outs"]], ...]
"""Weight and bias of each layer of a network, the last one linear."""
HiddenActivation = Literal["relu", "softplus"]
Corner = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class CombinedLattices:
    """Lattices, and how their features become one vector.

    Attributes:
        lattices: with detached features.
        combine: their combination.
        scale: factor of the combination (1/3 makes a tri-plane's sum a mean).
    """

    lattices: tuple[Lattice, ...]
    combine: Combination
    scale: float = 1.0

    @property
    def width(self) -> int:
        """Number of combined features."""
        channels = [lattice.channels for lattice in self.lattices]
        return {"concat": sum(channels), "vm": sum(channels[::2])}.get(self.combine, channels[0])


@dataclass(frozen=True)
class DensityHead:
    """From a raw value to a density.

    Attributes:
        activation: maps raw values + ``bias`` to densities; ``exp`` is clamped at exp(15).
        bias: added to raw values.
        scale: factor of densities.
        contracted: factor of densities in contracted space, besides `Bounds.radial_scale`; 0 for no factor at all.
    """

    activation: Literal["exp", "softplus", "relu"]
    bias: float = 0.0
    scale: float = 1.0
    contracted: float = 0.0


@dataclass(frozen=True, eq=False)
class ColourHead:
    """From features and a direction to radiance.

    Attributes:
        kind: ``mlp``: a network of features and direction. ``sh``: features are coefficients of spherical harmonics, all of
            red first, then green, then blue. ``none``: they are the raw colour.
        net: the network's layers; none for other kinds.
        octaves: sines and then cosines of 2^k times every feature, k = 0 .. octaves - 1, follow the features, feature by
            feature.
        direction: what follows those: ``frequency`` the direction and its sines and cosines as in NeRF (equation 4), ``sh``
            spherical harmonics.
        degree: octaves for ``frequency``; bands for ``sh``, 1 to 4.
        activation: of raw colour; ``clamp`` is max(0, 0.5 + x).
        padding: how far the sigmoid exceeds [0, 1] at both ends.
    """

    kind: Literal["mlp", "sh", "none"]
    net: Layers = ()
    octaves: int = 0
    direction: Literal["frequency", "sh", "none"] = "none"
    degree: int = 0
    activation: Literal["sigmoid", "softplus", "clamp"] = "sigmoid"
    padding: float = 0.0


@dataclass(frozen=True, eq=False)
class FusedLattice:
    """Detached parameters of a field over lattices, for fused inference.

    Geometry's features go through ``geometry_net``; its first output is the raw density. The others are features of colour;
    appearance's own, through ``basis``, follow them.

    Attributes:
        geometry: encoding of geometry.
        geometry_net: layers; none: its outputs are the features themselves.
        density: what becomes of the raw density.
        appearance: encoding that only colour sees; ``None`` for none.
        basis: layers that make colour's features of appearance's; none: they are those.
        colour: what becomes of colour's features.
        hidden: activation of hidden layers.
        crop: lowest and highest corner of the field's box, in unit coordinates of the bounds that are marched; the density is 0
            outside. ``None``: the box is all of the bounds.
    """

    geometry: CombinedLattices
    geometry_net: Layers
    density: DensityHead
    appearance: CombinedLattices | None
    basis: Layers
    colour: ColourHead
    hidden: HiddenActivation = "relu"
    crop: tuple[Corner, Corner] | None = None

    @property
    def geometry_features(self) -> int:
        """Number of geometry features: those that colour takes from geometry."""
        return (len(self.geometry_net[-1][1]) if self.geometry_net else self.geometry.width) - 1

    @property
    def appearance_features(self) -> int:
        """Number of appearance features: those that colour takes from appearance."""
        if self.appearance is None:
            return 0
        return len(self.basis[-1][1]) if self.basis else self.appearance.width
