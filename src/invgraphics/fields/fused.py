"""Detached parameters of neural fields for fused kernels: hash grids and lattices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from invgraphics.core.fused import ColourHead, CombinedLattices, DensityHead, FusedLattice, Layers
from invgraphics.core.ngp import FusedNGP
from invgraphics.fields.encodings.hash import HashEncoding
from invgraphics.fields.encodings.lattices import LatticeFeatures
from invgraphics.fields.heads import sums_components

if TYPE_CHECKING:
    from invgraphics.fields.neural import NeuralField


def fused_parts(field: NeuralField, scale: float, contracted: float) -> FusedNGP | FusedLattice | None:
    """Parameters of a field of densities over a hash grid or over lattices.

    Args:
        field: where they are.
        scale: factor of densities.
        contracted: half-extents per local unit in contracted space, 0 for none (see `FusedNGP.contracted_density`).

    Returns:
        ``None`` for other encodings, heads or networks than kernels support: of a hash grid with other than two features per
        entry or with a coarse-to-fine window, and of lattices whose density is activated before interpolation.
    """
    config = field.config
    if config.geometry != "density" or (config.geometry_head == "mlp" and config.skip >= 0):
        return None
    if isinstance(field.encoding, LatticeFeatures):
        return _lattice_parts(field, DensityHead(config.density_activation, config.density_bias, scale, contracted))
    return _hash_parts(field, contracted) if scale == 1 else None


def _hash_parts(field: NeuralField, contracted: float) -> FusedNGP | None:
    config, encoding = field.config, field.encoding
    if not config.two_plain_networks or config.direction not in ("sh", "none") or not isinstance(encoding, HashEncoding):
        return None
    # Entries of other widths have no compiled kernel, and the plain one keeps every sample of a picture.
    if encoding.window_alpha is not None or encoding.grid.features != 2:
        return None
    geometry, colour = (net.layers() for net in (field.geometry_net, field.colour_net))
    bands = config.direction_degree if config.direction == "sh" else 0
    density = config.density_activation, config.density_bias, bands, field.colour, contracted
    return FusedNGP(encoding.table.detach(), encoding.grid, geometry, colour, *density)


def _lattice_parts(field: NeuralField, density: DensityHead) -> FusedLattice | None:
    config, appearance = field.config, field.appearance
    if config.density_interpolation != "post" or not isinstance(appearance, LatticeFeatures | None):
        return None
    assert isinstance(field.encoding, LatticeFeatures)
    basis: Layers = ()
    if field.basis is not None:
        weight = field.basis.weight.detach()
        basis = ((weight, weight.new_zeros(len(weight))),)
    return FusedLattice(
        geometry=_combined(field.encoding),
        geometry_net=_geometry_net(field, field.encoding),
        density=density,
        appearance=None if appearance is None else _combined(appearance),
        basis=basis,
        colour=_colour_head(field),
        hidden=config.hidden_activation,
    )


def _combined(encoding: LatticeFeatures) -> CombinedLattices:
    return CombinedLattices(encoding.lattices(), encoding.combine, encoding.scale)


def _geometry_net(field: NeuralField, encoding: LatticeFeatures) -> Layers:
    """The geometry network; a row of ones where components are added up."""
    if field.config.geometry_head == "mlp":
        return field.geometry_net.layers()
    if not sums_components(encoding):
        return ()
    features = encoding.lattices()[0].features
    return ((torch.ones(1, encoding.width, dtype=features.dtype, device=features.device), features.new_zeros(1)),)


def _colour_head(field: NeuralField) -> ColourHead:
    config = field.config
    linear = field.colour == "linear"
    return ColourHead(
        kind=config.head,
        net=field.colour_net.layers() if config.head == "mlp" else (),
        octaves=config.feature_octaves,
        direction=config.direction,
        degree=config.direction_degree,
        activation="clamp" if config.colour_activation == "clamp" else "softplus" if linear else "sigmoid",
        padding=config.colour_padding,
    )
