"""Networks over an encoding of position: NeRF, Instant-NGP, signed distance functions; and grids, factors and planes.

A position goes through `Bounds.to_unit` and the encoding into ``geometry_net``, which says what is there (a density or a signed
distance) and hands a feature vector to ``colour_net``, which also sees the direction. A method is a choice of settings:
NeRF is 8 layers of 256 with a skip at 4 over 10 octaves, 256 geometry features and one colour layer of 128; Instant-NGP is one
layer of 64 over a hash encoding, 15 geometry features, two colour layers of 64, ``exp`` density and SH directions. A grid can
be the density itself; colour can have an encoding of its own, and a network, spherical harmonics or nothing above it (DVGO).

Densities are per local length unit, signed distances in local length units, whatever the size of the box.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Encoding, Field, Quantity
from invgraphics.core.fused import FusedLattice
from invgraphics.core.lattice import Lattice, LatticeEncoding, Role
from invgraphics.core.ngp import FusedNGP
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.fields import heads
from invgraphics.fields.covariance import unit_covariance
from invgraphics.fields.density import DensityActivation
from invgraphics.fields.encodings.lattices import LatticeConfig, LatticeFeatures, crop_lattices
from invgraphics.fields.fused import FieldParts, fused_parts
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.settings import NeuralSettings

CPU_CHUNK = 8192
"""Samples that go through the networks at once on a CPU: larger activations cost more in page faults than in arithmetic."""

INITIAL_RADIUS = 0.5
"""Radius of the sphere that a signed distance function starts as, in half-extents of the box (NeuS)."""

_POINTWISE = {
    "density": Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
    "sdf": Quantity.SDF | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
}


@dataclass(frozen=True)
class NeuralFieldConfig(NeuralSettings):
    """A neural field's settings, from which it is built (`NeuralSettings`)."""

    title: ClassVar[str] = "network"

    def build(self, scene: Scene) -> NeuralField:
        """Build the field for ``scene``'s bounds and colour space, its weights drawn from torch's global generator."""
        return NeuralField(self, scene.bounds, scene.colour)


@dataclass(frozen=True, eq=False)
class _NetworkOutputs:
    """Raw geometry and colour of one chunk.

    Attributes:
        raw: density before its activation, or signed distance.
        radiance: colour; ``None`` where it is not wanted.
        feature_grad: gradient of ``raw`` in the encoding's features; ``None`` without normals.
        geometry_features: features that geometry hands on to colour; ``None`` where they are not wanted.
    """

    raw: Float[Tensor, " m"]
    radiance: Float[Tensor, "m 3"] | None
    feature_grad: Float[Tensor, "m f"] | None
    geometry_features: Float[Tensor, "m h"] | None


class NeuralField(Field):
    """Density or signed distance, radiance and normal of an encoding, by two networks or simpler heads.

    Args:
        config: sizes and kinds.
        bounds: the region; density is zero outside it.
        colour: radiance is in [0, 1] for ``srgb``, in [0, inf) for ``linear``.

    Attributes:
        encoding: of positions, for geometry.
        geometry_net: its network; there is none with ``geometry_head = "none"``.
        appearance: encoding of positions for colour; ``None`` where colour sees geometry's features.
        basis: linear map of that encoding's features; ``None`` without.
        colour_net: colour's network; there is none with other heads.
    """

    lo: Tensor
    hi: Tensor
    geometry_net: Mlp
    colour_net: Mlp

    def __init__(self, config: NeuralFieldConfig, bounds: Bounds, colour: Literal["srgb", "linear"] = "srgb") -> None:
        super().__init__()
        self.config = config
        self.colour: Literal["srgb", "linear"] = colour
        self._space: Space = bounds.space
        self._near = bounds.near
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self._half = float(bounds.half.mean())  # at the start: no crop changes densities
        self.encoding = _build_encoding(config.encoding, bounds)
        self.appearance = None if config.appearance is None else _build_encoding(config.appearance, bounds)
        self.density_activation = DensityActivation(
            config.density_activation, config.density_bias, config.density_interpolation
        )
        if config.geometry_head == "mlp":
            self.geometry_net = heads.geometry_net(config, self.encoding.width)
        handed = heads.features_handed_on(config, self.encoding)
        own = 0 if self.appearance is None else config.appearance_basis or self.appearance.width
        heads.check_colour_features(config.head, handed + own)
        if config.head == "mlp":
            self.colour_net = heads.colour_net(config, handed + own)
        self.basis: nn.Linear | None = None
        if self.appearance is not None and config.appearance_basis:
            self.basis = nn.Linear(self.appearance.width, own, bias=False)
        # Colour with an encoding of its own is looked up where it is asked, not wherever a sampler asks for densities.
        without = Quantity.NONE if self.appearance is None else Quantity.FEATURES
        self.provides = _POINTWISE[config.geometry] & ~without
        self._needs_geometry_for_colour = handed > 0 or self.appearance is None
        if config.geometry == "sdf":
            self.geometry_net.initialise_as_sphere(INITIAL_RADIUS)

    @property
    def bounds(self) -> Bounds:
        """The region this field describes."""
        return Bounds(self.lo, self.hi, self._space, self._near)

    def lattice_encodings(self) -> dict[Role, LatticeEncoding]:
        """Its encodings that are lattices, by role; one that colour shares is geometry's."""
        encodings: dict[Role, Encoding | None] = {"geometry": self.encoding, "appearance": self.appearance}
        return {role: encoding for role, encoding in encodings.items() if isinstance(encoding, LatticeEncoding)}

    @torch.no_grad()
    def crop(self, lo: Float[Tensor, 3], hi: Float[Tensor, 3], resolution: float) -> None:
        """See `core.lattice.LatticeField`; densities inside the new box stay what they are."""
        encodings = [self.encoding] if self.appearance is None else [self.encoding, self.appearance]
        crop_lattices(encodings, self.bounds, (lo, hi), resolution)
        self.lo.copy_(lo)
        self.hi.copy_(hi)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`.

        Normals are the normalised gradient: of the signed distance, or of minus the density (taken before its activation,
        which is monotone, so that they are defined where the density saturates). They can be had inside ``no_grad``.
        Features are what geometry hands on to colour; samples that bring them along are not looked at again where only their
        radiance is wanted.
        """
        training = torch.is_grad_enabled()
        appearance = self._appearance(samples) if Quantity.RADIANCE in want else None
        known = samples.features if self._needs_geometry_for_colour else samples.position[:, :0]
        if want == Quantity.RADIANCE and known is not None:
            chunks = self._chunks(known, appearance, samples.direction)
            return FieldValues(radiance=torch.cat([self._radiance(*chunk) for chunk in chunks]))
        with_normal = Quantity.NORMAL in want
        with torch.set_grad_enabled(training or with_normal):
            position = samples.position
            if with_normal and not (training and position.requires_grad):
                position = position.detach().requires_grad_()
            features = self._encode(samples, position)
            chunks = self._chunks(features, appearance, samples.direction)
            parts = [self._evaluate(*chunk, want, training) for chunk in chunks]
            raw = torch.cat([part.raw for part in parts])
            normal = None
            if with_normal:
                feature_grad = torch.cat([part.feature_grad for part in parts if part.feature_grad is not None])
                (gradient,) = torch.autograd.grad(features, position, feature_grad, create_graph=training)
                normal = normalize(gradient if self.config.geometry == "sdf" else -gradient, dim=1)
        radiances = [part.radiance for part in parts if part.radiance is not None]
        geometry_features = [part.geometry_features for part in parts if part.geometry_features is not None]
        return FieldValues(
            density=self._density(raw, samples.position) if Quantity.DENSITY in want else None,
            sdf=raw * self.bounds.half.mean() if Quantity.SDF in want else None,
            radiance=torch.cat(radiances) if Quantity.RADIANCE in want else None,
            normal=normal,
            features=torch.cat(geometry_features) if Quantity.FEATURES in want else None,
        )

    @override
    def fused(self, bounds: Bounds) -> FusedNGP | FusedLattice | None:
        """Detached parameters over ``bounds``: of a hash grid over the field's own, or of lattices (see `fused_parts`)."""
        crop = None
        if not (torch.equal(bounds.lo, self.lo) and torch.equal(bounds.hi, self.hi)):
            lo, hi = (tuple(bounds.to_unit(corner).tolist()) for corner in (self.lo, self.hi))
            crop = lo, hi
        if bounds.space != self._space or (crop is not None and bounds.space != "box"):
            return None
        geometry_net = self.geometry_net if self.config.geometry_head == "mlp" else None
        colour_net = self.colour_net if self.config.head == "mlp" else None
        geometry = self.config, self.encoding, geometry_net
        colour = self.appearance, self.basis, colour_net, self.colour
        return fused_parts(FieldParts(*geometry, *colour, self._density_scale, self._contracted_density, crop))

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
        features = self._features(self.encoding, samples, position, unit)
        if self.config.geometry == "density":
            return features
        # In half-extents of the box, which is half as long as the unit cube in a contracted space.
        reach = 2 if self._space == "contracted" else 1
        return torch.cat([reach * (2 * unit - 1), features], dim=1)

    def _encode_activated(self, unit: Float[Tensor, "m 3"]) -> Float[Tensor, "m f"]:
        assert isinstance(self.encoding, LatticeFeatures)
        (grid,) = self.encoding.lattices()
        first = self.density_activation.at_vertices(grid.features[..., :1])
        features = torch.cat([first, grid.features[..., 1:]], dim=-1)
        return kernels.lattice_encode(unit, [Lattice(features, grid.axes, grid.links)], self.encoding.combine)

    def _appearance(self, samples: Samples) -> Float[Tensor, "m f"] | None:
        if self.appearance is None:
            return None
        return self._features(self.appearance, samples, samples.position, self.bounds.to_unit(samples.position))

    def _features(self, encoding: Encoding, samples: Samples, position: Tensor, unit: Tensor) -> Float[Tensor, "m f"]:
        covariance = unit_covariance(self.bounds, position, samples.covariance) if encoding.needs_covariance else None
        return encoding(unit, covariance)

    def _chunks(
        self, features: Tensor, appearance: Tensor | None, direction: Tensor
    ) -> Iterator[tuple[Tensor, Tensor | None, Tensor]]:
        size = CPU_CHUNK if direction.device.type == "cpu" else max(len(direction), 1)
        parts = features.split(size), direction.split(size)
        own = [None] * len(parts[0]) if appearance is None else appearance.split(size)
        return zip(parts[0], own, parts[1], strict=True)

    def _evaluate(
        self, features: Tensor, appearance: Tensor | None, direction: Tensor, want: Quantity, training: bool
    ) -> _NetworkOutputs:
        """Evaluate geometry and colour on one chunk; detached unless ``training``."""
        with_colour = Quantity.RADIANCE in want
        if Quantity.NORMAL in want and not training:
            # Starting the chunk's graph here keeps it from growing over all chunks.
            features = features.detach().requires_grad_()
        outputs = self._geometry(features, with_colour or Quantity.FEATURES in want)
        raw, feature_grad = outputs[:, 0], None
        if Quantity.NORMAL in want:
            (feature_grad,) = torch.autograd.grad(raw.sum(), features, create_graph=training)
        if not training:
            raw, outputs = raw.detach(), outputs.detach()
        with torch.set_grad_enabled(training):
            geometry_features = outputs[:, 1:]
            radiance = self._radiance(geometry_features, appearance, direction) if with_colour else None
            return _NetworkOutputs(raw, radiance, feature_grad, geometry_features if Quantity.FEATURES in want else None)

    def _geometry(self, features: Float[Tensor, "m f"], with_features: bool) -> Float[Tensor, "m o"]:
        """Raw geometry, and behind it the features that are handed on."""
        if self.config.geometry_head == "mlp":
            return self.geometry_net(features, None if with_features else 1)
        return features.sum(dim=1, keepdim=True) if heads.sums_components(self.encoding) else features

    def _radiance(
        self, geometry: Float[Tensor, "m g"], appearance: Float[Tensor, "m a"] | None, direction: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        features = geometry
        if appearance is not None:
            own = appearance if self.basis is None else self.basis(appearance)
            features = torch.cat([geometry, own], dim=1) if self._needs_geometry_for_colour else own
        raw = heads.raw_colour(self.colour_net if self.config.head == "mlp" else None, features, direction, self.config)
        return heads.activated_colour(raw, self.config, self.colour)

    def _density(self, raw: Float[Tensor, " m"], position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        density = self.density_activation.at_points(raw)
        if self._contracted_density > 0:
            density = density * (self._contracted_density * self.bounds.radial_scale(position))
        if self._density_scale != 1:
            density = density * self._density_scale
        return torch.where(self.bounds.contains(position), density, torch.zeros_like(density))


def _build_encoding(config: Any, bounds: Bounds) -> Encoding:
    return config.build(bounds.half.tolist()) if isinstance(config, LatticeConfig) else config.build()
