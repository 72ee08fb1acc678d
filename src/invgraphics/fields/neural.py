"""Networks over an encoding of position: NeRF, Instant-NGP, signed distance functions; and grids, factors and planes.

A position goes through `Bounds.to_unit` and the encoding into ``geometry_net``, which outputs a density or a signed distance,
and features for ``colour_net``, which also takes the direction. A method is a choice of settings: NeRF is 8 layers of 256
with a skip at 4 over 10 octaves, 256 geometry features and one colour layer of 128; Instant-NGP is one layer of 64 over a hash
encoding, 15 geometry features, two colour layers of 64, ``exp`` density and SH directions. A grid can be the density itself;
colour can have an encoding of its own, and a network, spherical harmonics or nothing above it (DVGO).

Densities are per local length unit, signed distances in local length units, whatever the size of the box.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Encoding, Field, Quantity
from invgraphics.core.fused import Corner, FusedLattice
from invgraphics.core.lattice import Lattice, LatticeEncoding, Role
from invgraphics.core.ngp import FusedNGP, FusedSDF
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.fields import heads
from invgraphics.fields.density import DensityActivation
from invgraphics.fields.encoded import build_encoding, encode_samples, resolve_encodings
from invgraphics.fields.encodings.lattices import LatticeFeatures, crop_lattices
from invgraphics.fields.fused import FieldParts, fused_parts, fused_surface, sdf_parts
from invgraphics.fields.geometry import chunks, query_geometry
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.settings import NeuralSettings
from invgraphics.fields.starting import SOLID, hollow_radius

_POINTWISE = {
    "density": Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
    "sdf": Quantity.SDF | Quantity.GRADIENT | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
}


@dataclass(frozen=True)
class NeuralFieldConfig(NeuralSettings):
    """A neural field's settings, from which it is built (`NeuralSettings`)."""

    title: ClassVar[str] = "network"

    def build(self, scene: Scene) -> NeuralField:
        """Build the field for ``scene``'s bounds and colour space, its weights drawn from torch's global generator."""
        return NeuralField(resolve_encodings(self, scene), scene.bounds, scene.colour, hollow=hollow_radius(scene))


class NeuralField(Field):
    """Density or signed distance, radiance and normal of an encoding, by two networks or simpler heads.

    Args:
        config: sizes and kinds.
        bounds: the region; density is zero outside it.
        colour: radiance is in [0, 1] for ``srgb``, in [0, inf) for ``linear``.
        hollow: radius of the hollow sphere that a signed distance starts as, local units; ``None`` for a solid one.

    Attributes:
        encoding: of positions, for geometry.
        geometry_net: its network; there is none with ``geometry_head = "none"``.
        appearance: encoding of positions for colour; ``None`` where colour sees geometry's features.
        basis: linear map of that encoding's features; ``None`` without.
        colour_net: colour's network; there is none with other heads.
    """

    lo: Tensor
    hi: Tensor
    _middle: Tensor
    geometry_net: Mlp
    colour_net: Mlp

    def __init__(
        self,
        config: NeuralFieldConfig,
        bounds: Bounds,
        colour: Literal["srgb", "linear"] = "srgb",
        *,
        hollow: float | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.colour: Literal["srgb", "linear"] = colour
        self._space: Space = bounds.space
        self._near = bounds.near
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self._half = float(bounds.half.mean())  # of the box at the start: no crop changes values
        self.register_buffer("_middle", bounds.centre.clone(), persistent=False)
        self.encoding = build_encoding(config.encoding, bounds)
        self.appearance = None if config.appearance is None else build_encoding(config.appearance, bounds)
        self.density_activation = DensityActivation(
            config.density_activation, config.density_bias, config.density_interpolation
        )
        if config.geometry_head == "mlp":
            self.geometry_net = heads.geometry_net(config, self.encoding.width)
        width = heads.geometry_feature_width(config, self.encoding)
        own = 0 if self.appearance is None else config.appearance_basis or self.appearance.width
        heads.check_colour_features(config.head, width + own)
        if config.head == "mlp":
            self.colour_net = heads.colour_net(config, width + own + 3 * len(config.colour_inputs))
        self.basis: nn.Linear | None = None
        if self.appearance is not None and config.appearance_basis:
            self.basis = nn.Linear(self.appearance.width, own, bias=False)
        # A separate appearance encoding is evaluated only where radiance is queried: density queries provide no features.
        without = Quantity.NONE if self.appearance is None else Quantity.FEATURES
        self.provides = _POINTWISE[config.geometry] & ~without
        self._needs_geometry_for_colour = width > 0 or self.appearance is None
        self._geometry_feature_width = width
        if config.geometry == "sdf":
            radius = SOLID * float(bounds.half.min()) if hollow is None else hollow
            self.geometry_net.initialise_as_sphere(radius / self._half, inside_out=hollow is not None)

    @property
    def bounds(self) -> Bounds:
        """The region this field describes."""
        return Bounds(self.lo, self.hi, self._space, self._near)

    @property
    @override
    def feature_width(self) -> int | None:
        return self._geometry_feature_width if Quantity.FEATURES in self.provides else None

    def lattice_encodings(self) -> dict[Role, LatticeEncoding]:
        """Its encodings that are lattices, by role; one that colour shares is geometry's."""
        encodings: dict[Role, Encoding | None] = {"geometry": self.encoding, "appearance": self.appearance}
        return {role: encoding for role, encoding in encodings.items() if isinstance(encoding, LatticeEncoding)}

    @property
    def croppable(self) -> bool:
        """See `core.lattice.LatticeField`."""
        return self._space == "box" and len(self.lattice_encodings()) == 1 + (self.appearance is not None)

    @torch.no_grad()
    def crop(self, lo: Float[Tensor, 3], hi: Float[Tensor, 3], resolution: float) -> None:
        """See `core.lattice.LatticeField`; densities inside the new box stay what they are."""
        crop_lattices(self, lo, hi, resolution)
        self.lo.copy_(lo)
        self.hi.copy_(hi)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`.

        Gradients and normals can be had inside ``no_grad``. A normal is the normalised gradient: of the signed distance, or of
        minus the density (taken before its activation, which is monotone, so that it is defined where the density saturates).
        Features are the geometry features; of samples that hold them, geometry is not evaluated again where only radiance is
        wanted and colour sees no normal.
        """
        alone = want in (Quantity.SDF, Quantity.RADIANCE) and not torch.is_grad_enabled()
        if alone and self._space == "box" and kernels.compiled("sdf_values", samples.position):
            values = fused_surface(self.fused_sdf(self.bounds), samples, self.bounds, want)
            if values is not None:
                return values
        appearance = self._appearance(samples) if Quantity.RADIANCE in want else None
        sees_normal = Quantity.RADIANCE in want and "normal" in self.config.colour_inputs
        known = samples.features if self._needs_geometry_for_colour else samples.position[:, :0]
        if want == Quantity.RADIANCE and known is not None and not sees_normal:
            return FieldValues(radiance=self._radiance(known, appearance, samples, None))
        geometry = query_geometry(
            partial(self._encode, samples),
            self._geometry,
            samples.position,
            with_features=bool(want & (Quantity.RADIANCE | Quantity.FEATURES)),
            with_gradient=sees_normal or bool(want & (Quantity.GRADIENT | Quantity.NORMAL)),
        )
        sdf = self.config.geometry == "sdf"
        normal = None if geometry.gradient is None else normalize(geometry.gradient if sdf else -geometry.gradient, dim=1)
        radiance = None
        if Quantity.RADIANCE in want:
            assert geometry.features is not None
            radiance = self._radiance(geometry.features, appearance, samples, normal)
        return FieldValues(
            density=self._density(geometry.raw, samples.position) if Quantity.DENSITY in want else None,
            sdf=geometry.raw * self._half if Quantity.SDF in want else None,
            gradient=geometry.gradient * self._half if Quantity.GRADIENT in want and geometry.gradient is not None else None,
            radiance=radiance,
            normal=normal if Quantity.NORMAL in want else None,
            features=geometry.features if Quantity.FEATURES in want else None,
        )

    @override
    def fused(self, bounds: Bounds) -> FusedNGP | FusedLattice | None:
        """Detached parameters over ``bounds``: of a hash grid over the field's own, or of lattices (see `fused_parts`)."""
        crop = None
        if not self._covers(bounds):
            if bounds.space != self._space or bounds.space != "box":
                return None
            lo, hi = (tuple(bounds.to_unit(corner).tolist()) for corner in (self.lo, self.hi))
            crop = lo, hi
        return fused_parts(self._parts(crop))

    @override
    def fused_sdf(self, bounds: Bounds) -> FusedSDF | None:
        """Detached parameters of a signed distance over ``bounds``, its own: of a hash grid or octaves (see `sdf_parts`)."""
        if self.config.geometry != "sdf" or not self._covers(bounds) or not torch.equal(self.bounds.centre, self._middle):
            return None
        return sdf_parts(self._parts(), self.bounds.half / self._half, self._half)

    def _parts(self, crop: tuple[Corner, Corner] | None = None) -> FieldParts:
        geometry_net = self.geometry_net if self.config.geometry_head == "mlp" else None
        colour_net = self.colour_net if self.config.head == "mlp" else None
        geometry, colour = (self.config, self.encoding, geometry_net), (self.appearance, self.basis, colour_net)
        return FieldParts(*geometry, *colour, self.colour, self._density_scale, self._contracted_density, crop)

    def _covers(self, bounds: Bounds) -> bool:
        return bounds.space == self._space and torch.equal(bounds.lo, self.lo) and torch.equal(bounds.hi, self.hi)

    @property
    def _contracted_density(self) -> float:
        """Half-extents per local unit, which scale densities given per contracted half-extent; 0 for other densities."""
        contracted = self._space == "contracted" and self.config.density_per != "local"
        return 1 / self._half if contracted else 0.0

    @property
    def _density_scale(self) -> float:
        """Factor of densities besides that of contracted space."""
        per_half = self._space == "box" and self.config.density_per == "half"
        return self.config.density_scale / (self._half if per_half else 1.0)

    def _encode(self, samples: Samples, position: Float[Tensor, "m 3"]) -> Float[Tensor, "m f"]:
        """Features for geometry; of a grid whose density is activated before interpolation, the first is that density."""
        unit = self.bounds.to_unit(position)
        if self.density_activation.interpolation != "post":
            return self._encode_activated(unit)
        features = encode_samples(self.encoding, self.bounds, replace(samples, position=position), unit)
        if self.config.geometry == "density":
            return features
        return torch.cat([self._coordinates(unit), features], dim=1)

    def _coordinates(self, unit: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Positions from the middle of the box, in its mean half-extents; after contraction where space is contracted."""
        bounds, reach = self.bounds, 2 if self._space == "contracted" else 1  # there the box has half the unit cube's edge
        return (2 * unit - 1) * (reach * bounds.half / self._half) + (bounds.centre - self._middle) / self._half

    def _encode_activated(self, unit: Float[Tensor, "m 3"]) -> Float[Tensor, "m f"]:
        assert isinstance(self.encoding, LatticeFeatures)
        (grid,) = self.encoding.lattices()
        first = self.density_activation.at_vertices(grid.features[..., :1])
        features = torch.cat([first, grid.features[..., 1:]], dim=-1)
        return kernels.lattice_encode(unit, [Lattice(features, grid.axes, grid.links)], self.encoding.combine)

    def _appearance(self, samples: Samples) -> Float[Tensor, "m f"] | None:
        if self.appearance is None:
            return None
        return encode_samples(self.appearance, self.bounds, samples, self.bounds.to_unit(samples.position))

    def _geometry(self, features: Float[Tensor, "m f"], with_features: bool) -> Float[Tensor, "m o"]:
        """Raw geometry, followed by the geometry features."""
        if self.config.geometry_head == "mlp":
            return self.geometry_net(features, None if with_features else 1)
        return features.sum(dim=1, keepdim=True) if heads.sums_components(self.encoding) else features

    def _radiance(
        self,
        geometry: Float[Tensor, "m g"],
        appearance: Float[Tensor, "m a"] | None,
        samples: Samples,
        normal: Float[Tensor, "m 3"] | None,
    ) -> Float[Tensor, "m 3"]:
        """Colour from the geometry features, the appearance's and ``colour_inputs``, chunk by chunk."""
        position = None
        if "position" in self.config.colour_inputs:
            position = self._coordinates(self.bounds.to_unit(samples.position))
        seen = normal if "normal" in self.config.colour_inputs else None
        parts = [self._radiance_of(*chunk) for chunk in chunks(samples.direction, geometry, appearance, position, seen)]
        return torch.cat(parts)

    def _radiance_of(
        self, direction: Float[Tensor, "m 3"], geometry: Tensor, appearance: Tensor | None, *surface: Tensor | None
    ) -> Float[Tensor, "m 3"]:
        parts = [part for part in surface if part is not None]
        if self._needs_geometry_for_colour:
            parts.append(geometry)
        if appearance is not None:
            parts.append(appearance if self.basis is None else self.basis(appearance))
        features = parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)
        raw = heads.raw_colour(self.colour_net if self.config.head == "mlp" else None, features, direction, self.config)
        return heads.activated_colour(raw, self.config, self.colour)

    def _density(self, raw: Float[Tensor, " m"], position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        density = self.density_activation.at_points(raw)
        if self._contracted_density > 0:
            density = density * (self._contracted_density * self.bounds.radial_scale(position))
        if self._density_scale != 1:
            density = density * self._density_scale
        return torch.where(self.bounds.contains(position), density, torch.zeros_like(density))
