"""Detached parameters of neural fields for fused kernels: hash grids and lattices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeGuard

import torch
from torch import Tensor, nn

from invgraphics import kernels
from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Encoding, Quantity
from invgraphics.core.fused import ColourHead, CombinedLattices, Corner, DensityHead, FusedLattice, Layers
from invgraphics.core.ngp import FusedColour, FusedNGP, FusedSDF
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.fields.encodings.frequency import FrequencyEncoding
from invgraphics.fields.encodings.hash import HashEncoding
from invgraphics.fields.encodings.lattices import LatticeFeatures
from invgraphics.fields.encodings.sparse import SparseVoxels
from invgraphics.fields.heads import sums_components
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.settings import NeuralSettings


@dataclass(frozen=True, eq=False)
class FieldParts:
    """Modules and settings of a neural field, as its attributes of the same names.

    Attributes:
        density_scale: factor of densities.
        contracted_density: half-extents per local unit in contracted space, 0 for none (see `FusedNGP.contracted_density`).
        crop: the field's box, where it is not all of the bounds (see `FusedLattice`).
    """

    config: NeuralSettings
    encoding: Encoding
    geometry_net: Mlp | None
    appearance: Encoding | None
    basis: nn.Linear | None
    colour_net: Mlp | None
    colour: Literal["srgb", "linear"]
    density_scale: float
    contracted_density: float
    crop: tuple[Corner, Corner] | None = None


def fused_parts(field: FieldParts) -> FusedNGP | FusedLattice | None:
    """Parameters of a field of densities over a hash grid or over lattices.

    Returns:
        ``None`` for other encodings, heads or networks than kernels support: of a hash grid with other than two features per
        entry or with a coarse-to-fine window, of lattices whose density is activated before interpolation, of colours that
        see more than features and direction.
    """
    config = field.config
    if config.geometry != "density" or config.colour_inputs or (config.geometry_head == "mlp" and config.skip >= 0):
        return None
    if isinstance(field.encoding, LatticeFeatures | SparseVoxels):
        return _lattice_parts(field)
    return _hash_parts(field) if field.density_scale == 1 and field.crop is None else None


def _hash_parts(field: FieldParts) -> FusedNGP | None:
    config, encoding = field.config, field.encoding
    if not config.two_plain_networks or config.direction not in ("sh", "none") or field.appearance is not None:
        return None
    # Entries of other widths have no compiled kernel, and the plain one keeps every sample of a picture.
    if not _is_paired_grid(encoding):
        return None
    geometry, colour = _layers(field.geometry_net), _layers(field.colour_net)
    return FusedNGP(
        table=encoding.table.detach(),
        grid=encoding.grid,
        density_net=geometry,
        colour_net=colour,
        density_activation=config.density_activation,
        density_bias=config.density_bias,
        sh_bands=_sh_bands(config),
        colour_space=field.colour,
        contracted_density=field.contracted_density,
    )


def sdf_parts(field: FieldParts, coordinate_scale: Tensor, scale: float) -> FusedSDF | None:
    """Parameters of a signed distance over a hash grid of two features per entry or over octaves; ``None`` for others.

    Args:
        field: modules and settings; ``geometry_net`` takes coordinates and features.
        coordinate_scale: see `FusedSDF`.
        scale: local length of the network's unit.
    """
    encoding, net = field.encoding, field.geometry_net
    if field.config.skip >= 0 or net is None or net.sharpness is None or not field.config.layers:
        return None
    *hidden, (weight, bias) = net.layers()
    if not isinstance(encoding, HashEncoding | FrequencyEncoding) or encoding.window_alpha is not None:
        return None
    if isinstance(encoding, FrequencyEncoding):
        supported, table, grid, octaves = encoding.config.include_input, weight.new_zeros(0, 2), None, encoding.config.octaves
    else:
        supported, table, grid, octaves = encoding.grid.features == 2, encoding.table.detach(), encoding.grid, 0
    if not supported:
        return None
    return FusedSDF(
        table=table,
        grid=grid,
        octaves=octaves,
        net=(*hidden, (weight[:1], bias[:1])),
        sharpness=net.sharpness,
        coordinate_scale=coordinate_scale,
        scale=scale,
        colour=_surface_colour(field),
    )


def fused_surface(parts: FusedSDF | None, samples: Samples, bounds: Bounds, want: Quantity) -> FieldValues | None:
    """Signed distances alone or radiance alone by a fused kernel, outside the graph; ``None`` without its parameters."""
    if parts is None:
        return None
    if want == Quantity.SDF:
        return FieldValues(sdf=kernels.sdf_values(samples.position, bounds, parts))
    if parts.colour is None or samples.features is not None:
        return None
    return FieldValues(radiance=kernels.sdf_radiance(samples.position, samples.direction, bounds, parts))


def _surface_colour(field: FieldParts) -> FusedColour | None:
    """Parameters of the colour of a signed distance; ``None`` where colour sees more than kernels do."""
    config, appearance = field.config, field.appearance
    if not config.two_plain_networks or config.direction not in ("sh", "none"):
        return None
    geometry, colour = _layers(field.geometry_net), _layers(field.colour_net)
    table, grid = colour[0][0].new_zeros(0, 2), None
    if appearance is not None:
        if not _is_paired_grid(appearance):
            return None
        table, grid = appearance.table.detach(), appearance.grid
    return FusedColour(geometry, table, grid, colour, _sh_bands(config), field.colour)


def _is_paired_grid(encoding: Encoding) -> TypeGuard[HashEncoding]:
    """Whether an encoding is a hash grid with two features per entry and without a coarse-to-fine window."""
    return isinstance(encoding, HashEncoding) and encoding.window_alpha is None and encoding.grid.features == 2


def _sh_bands(config: NeuralSettings) -> int:
    return config.direction_degree if config.direction == "sh" else 0


def _lattice_parts(field: FieldParts) -> FusedLattice | None:
    config, appearance = field.config, field.appearance
    if config.density_interpolation != "post" or not isinstance(appearance, LatticeFeatures | SparseVoxels | None):
        return None
    assert isinstance(field.encoding, LatticeFeatures | SparseVoxels)
    basis: Layers = ()
    if field.basis is not None:
        weight = field.basis.weight.detach()
        basis = ((weight, weight.new_zeros(len(weight))),)
    return FusedLattice(
        geometry=_combined(field.encoding),
        geometry_net=_geometry_net(field, field.encoding),
        density=DensityHead(config.density_activation, config.density_bias, field.density_scale, field.contracted_density),
        appearance=None if appearance is None else _combined(appearance),
        basis=basis,
        colour=_colour_head(field),
        hidden=config.hidden_activation,
        crop=field.crop,
    )


def _combined(encoding: LatticeFeatures | SparseVoxels) -> CombinedLattices:
    return CombinedLattices(encoding.lattices(), encoding.combine, encoding.scale)


def _geometry_net(field: FieldParts, encoding: LatticeFeatures | SparseVoxels) -> Layers:
    """The geometry network; a row of ones where components are added up."""
    if field.config.geometry_head == "mlp":
        return _layers(field.geometry_net)
    if not sums_components(encoding):
        return ()
    features = encoding.lattices()[0].features
    return ((torch.ones(1, encoding.width, dtype=features.dtype, device=features.device), features.new_zeros(1)),)


def _colour_head(field: FieldParts) -> ColourHead:
    config = field.config
    linear = field.colour == "linear"
    return ColourHead(
        kind=config.head,
        net=_layers(field.colour_net),
        octaves=config.feature_octaves,
        direction=config.direction,
        degree=config.direction_degree,
        activation="clamp" if config.colour_activation == "clamp" else "softplus" if linear else "sigmoid",
        padding=config.colour_padding,
    )


def _layers(net: Mlp | None) -> Layers:
    return () if net is None else net.layers()
