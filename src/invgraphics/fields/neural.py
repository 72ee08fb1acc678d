"""Networks over an encoding of position: NeRF, Instant-NGP, and signed distance functions.

A position goes through `Bounds.to_unit` and the encoding into ``geometry_net``, which says what is there (a density or a signed
distance) and hands a feature vector to ``colour_net``, which also sees the direction. A method is a choice of settings:
NeRF is 8 layers of 256 with a skip at 4 over 10 octaves, 256 geometry features and one colour layer of 128; Instant-NGP is one
layer of 64 over a hash encoding, 15 geometry features, two colour layers of 64, ``exp`` density and SH directions.

Densities are per local length unit, signed distances in local length units, whatever the size of the box.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, relu, softplus
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Encoding, Field, Quantity
from invgraphics.core.ngp import FusedNGP
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.fields.encodings.frequency import FrequencyConfig, frequencies, frequency_width
from invgraphics.fields.encodings.hash import HashEncoding
from invgraphics.fields.mlp import Mlp, truncated_exp

CPU_CHUNK = 8192
"""Samples that go through the networks at once on a CPU: larger activations cost more in page faults than in arithmetic."""

INITIAL_RADIUS = 0.5
"""Radius of the sphere that a signed distance function starts as, in half-extents of the box (NeuS)."""

_POINTWISE = {
    "density": Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
    "sdf": Quantity.SDF | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES,
}


@dataclass(frozen=True)
class NeuralFieldConfig:
    """An encoding and two networks.

    Attributes:
        encoding: position to features.
        geometry: what the first network says: volume density, or signed distance (started as a sphere).
        layers: hidden layers of the geometry network.
        width: features of each.
        skip: hidden layer after which the encoding is concatenated once more, counted from 0; -1 for none.
        geometry_features: features that the geometry network hands to the colour network.
        colour_layers: hidden layers of the colour network.
        colour_width: features of each.
        direction: how the colour network sees the viewing direction; ``none`` makes colour independent of it.
        direction_degree: octaves for ``frequency``; bands for ``sh``, 1 to 4.
        density_activation: ``exp`` stops growing at exp(15); not used for ``sdf``.
        density_bias: added before that activation (mip-NeRF: softplus and -1).
        density_per: unit of length of the network's density. ``contracted``: in a contracted space, the box's half-extent after
            contraction along the radius, so that a new field is as thin a fog all the way to infinity as in a box.
    """

    title: ClassVar[str] = "network"

    encoding: Annotated[Any, Slot("encodings")] = field(default_factory=FrequencyConfig)
    geometry: Literal["density", "sdf"] = "density"
    layers: int = 8
    width: int = 256
    skip: int = 4
    geometry_features: int = 256
    colour_layers: int = 1
    colour_width: int = 128
    direction: Literal["frequency", "sh", "none"] = "frequency"
    direction_degree: int = 4
    density_activation: Literal["softplus", "exp", "relu"] = "softplus"
    density_bias: float = -1.0
    density_per: Literal["local", "contracted"] = "local"

    def __post_init__(self) -> None:
        if self.layers < 0 or self.colour_layers < 0:
            raise ValueError("layers and colour_layers cannot be negative.")
        if min(self.width, self.colour_width) < 1 or self.geometry_features < 0:
            raise ValueError("width and colour_width must be at least 1, geometry_features at least 0.")
        if not -1 <= self.skip < self.layers:
            raise ValueError(f"skip must name one of the {self.layers} hidden layers (from 0) or be -1, not {self.skip}.")
        if self.direction == "sh" and not 1 <= self.direction_degree <= harmonics.MAX_DEGREE + 1:
            raise ValueError(f"direction_degree must be 1 to {harmonics.MAX_DEGREE + 1} for 'sh', not {self.direction_degree}.")
        if self.direction_degree < 0:
            raise ValueError("direction_degree cannot be negative.")
        if self.geometry_features == 0 and self.direction == "none":
            raise ValueError("with geometry_features = 0 and direction = 'none' colour would be the same everywhere.")

    @property
    def direction_width(self) -> int:
        """Number of features of a direction."""
        widths = {"frequency": frequency_width(self.direction_degree), "sh": self.direction_degree**2, "none": 0}
        return widths[self.direction]

    def build(self, scene: Scene) -> NeuralField:
        """Build the field for ``scene``'s bounds and colour space, its weights drawn from torch's global generator."""
        return NeuralField(self, scene.bounds, scene.colour)


@dataclass(frozen=True, eq=False)
class _NetworkOutputs:
    """Outputs of both networks on one chunk.

    Attributes:
        raw: density before its activation, or signed distance.
        radiance: colour; ``None`` where it is not wanted.
        feature_grad: gradient of ``raw`` in the encoding's features; ``None`` without normals.
        geometry_features: outputs of the geometry network that the colour network takes; ``None`` where they are not wanted.
    """

    raw: Float[Tensor, " m"]
    radiance: Float[Tensor, "m 3"] | None
    feature_grad: Float[Tensor, "m f"] | None
    geometry_features: Float[Tensor, "m h"] | None


class NeuralField(Field):
    """Density or signed distance, radiance and normal by two networks over an encoding.

    Args:
        config: sizes and kinds.
        bounds: the region; density is zero outside it.
        colour: radiance is in [0, 1] for ``srgb``, in [0, inf) for ``linear``.
    """

    lo: Tensor
    hi: Tensor

    def __init__(self, config: NeuralFieldConfig, bounds: Bounds, colour: Literal["srgb", "linear"] = "srgb") -> None:
        super().__init__()
        self.config = config
        self.provides = _POINTWISE[config.geometry]
        self.colour: Literal["srgb", "linear"] = colour
        self._space: Space = bounds.space
        self._near = bounds.near
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self.encoding: Encoding = config.encoding.build()
        signed = config.geometry == "sdf"
        self.geometry_net = Mlp(
            # A distance function also sees the plain coordinates, which its start as a sphere is made of.
            inputs=self.encoding.width + (3 if signed else 0),
            layers=config.layers,
            width=config.width,
            outputs=1 + config.geometry_features,
            skip=config.skip,
            smooth=signed,
        )
        self.colour_net = Mlp(
            inputs=config.geometry_features + config.direction_width,
            layers=config.colour_layers,
            width=config.colour_width,
            outputs=3,
            smooth=signed,
        )
        if signed:
            self.geometry_net.initialise_as_sphere(INITIAL_RADIUS)

    @property
    def bounds(self) -> Bounds:
        """The region this field describes."""
        return Bounds(self.lo, self.hi, self._space, self._near)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`.

        Normals are the normalised gradient: of the signed distance, or of minus the density (taken before its activation,
        which is monotone, so that they are defined where the density saturates). They can be had inside ``no_grad``.
        Features are what the geometry network hands to the colour network; samples that bring them along are not looked at
        again where only their radiance is wanted.
        """
        training = torch.is_grad_enabled()
        if want == Quantity.RADIANCE and samples.features is not None:
            chunks = self._chunks(samples.features, samples.direction)
            return FieldValues(radiance=torch.cat([self._radiance(*chunk) for chunk in chunks]))
        with_normal = Quantity.NORMAL in want
        with torch.set_grad_enabled(training or with_normal):
            position = samples.position
            if with_normal and not (training and position.requires_grad):
                position = position.detach().requires_grad_()
            features = self._encode(samples, position)
            parts = [self._evaluate(*chunk, want, training) for chunk in self._chunks(features, samples.direction)]
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
    def fused(self, bounds: Bounds) -> FusedNGP | None:
        """Detached hash grid and networks over ``bounds``.

        ``None`` for other encodings, networks or bounds, for other than two features per entry, and with a coarse-to-fine
        window.
        """
        config, encoding = self.config, self.encoding
        plain = config.geometry == "density" and config.skip < 0 and config.direction in ("sh", "none")
        here = bounds.space == self._space and torch.equal(bounds.lo, self.lo) and torch.equal(bounds.hi, self.hi)
        if not plain or not here or not isinstance(encoding, HashEncoding):
            return None
        # Entries of other widths have no compiled kernel, and the plain one keeps every sample of a picture.
        if encoding.window_alpha is not None or encoding.grid.features != 2:
            return None
        geometry, colour = (net.layers() for net in (self.geometry_net, self.colour_net))
        bands = config.direction_degree if config.direction == "sh" else 0
        density = config.density_activation, config.density_bias, bands, self.colour, self._contracted_density
        return FusedNGP(encoding.table.detach(), encoding.grid, geometry, colour, *density)

    @property
    def _contracted_density(self) -> float:
        """Half-extents per local unit, which scale densities given per contracted half-extent; 0 for other densities."""
        contracted = self._space == "contracted" and self.config.density_per == "contracted"
        return 1 / float(self.bounds.half.mean()) if contracted else 0.0

    def _encode(self, samples: Samples, position: Float[Tensor, "m 3"]) -> Float[Tensor, "m f"]:
        unit = self.bounds.to_unit(position)
        covariance = None
        if self.encoding.needs_covariance:
            covariance = unit_covariance(self.bounds, position, samples.covariance)
        features = self.encoding(unit, covariance)
        if self.config.geometry == "density":
            return features
        # In half-extents of the box, which is half as long as the unit cube in a contracted space.
        reach = 2 if self._space == "contracted" else 1
        return torch.cat([reach * (2 * unit - 1), features], dim=1)

    def _chunks(self, features: Tensor, direction: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        size = CPU_CHUNK if features.device.type == "cpu" else max(len(features), 1)
        return zip(features.split(size), direction.split(size), strict=True)

    def _evaluate(self, features: Tensor, direction: Tensor, want: Quantity, training: bool) -> _NetworkOutputs:
        """Evaluate both networks on one chunk; detached unless ``training``."""
        with_colour = Quantity.RADIANCE in want
        if Quantity.NORMAL in want and not training:
            # Starting the chunk's graph here keeps it from growing over all chunks.
            features = features.detach().requires_grad_()
        outputs = self.geometry_net(features, None if with_colour or Quantity.FEATURES in want else 1)
        raw, feature_grad = outputs[:, 0], None
        if Quantity.NORMAL in want:
            (feature_grad,) = torch.autograd.grad(raw.sum(), features, create_graph=training)
        if not training:
            raw, outputs = raw.detach(), outputs.detach()
        with torch.set_grad_enabled(training):
            geometry_features = outputs[:, 1:]
            radiance = self._radiance(geometry_features, direction) if with_colour else None
            return _NetworkOutputs(raw, radiance, feature_grad, geometry_features if Quantity.FEATURES in want else None)

    def _radiance(self, geometry: Tensor, direction: Tensor) -> Float[Tensor, "m 3"]:
        degree = self.config.direction_degree
        if self.config.direction == "frequency":
            geometry = torch.cat([geometry, frequencies(direction, degree)], dim=1)
        elif self.config.direction == "sh":
            geometry = torch.cat([geometry, harmonics.basis(direction, degree - 1)], dim=1)
        raw = self.colour_net(geometry)
        return raw.sigmoid() if self.colour == "srgb" else softplus(raw)

    def _density(self, raw: Float[Tensor, " m"], position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        activation = {"softplus": softplus, "exp": truncated_exp, "relu": relu}[self.config.density_activation]
        density = activation(raw + self.config.density_bias)
        if self._contracted_density > 0:
            density = density * (self._contracted_density * self.bounds.radial_scale(position))
        return torch.where(self.bounds.contains(position), density, torch.zeros_like(density))


def unit_covariance(
    bounds: Bounds, position: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"]
) -> Float[Tensor, "m 3 3"]:
    """Transform covariances to the unit cube by the linearised map J Σ J^T (mip-NeRF 360, equation 9)."""
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad():
        if not (differentiable and position.requires_grad):
            position = position.detach().requires_grad_()
        unit = bounds.to_unit(position)
        rows = [
            torch.autograd.grad(u.sum(), position, create_graph=differentiable, retain_graph=True)[0] for u in unit.unbind(1)
        ]
    jacobian = torch.stack(rows, dim=1)
    return jacobian @ covariance @ jacobian.mT
