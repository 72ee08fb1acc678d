"""A density alone, of an encoding and a small network: what a proposal sampler places samples by (mip-NeRF 360, §3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Field, Quantity
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.fields.density import Activation, DensityActivation
from invgraphics.fields.encoded import build_encoding, encode_samples, resolve_encodings
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.geometry import chunks
from invgraphics.fields.mlp import Mlp


@dataclass(frozen=True)
class DensityFieldConfig:
    """A density network over an encoding; the defaults are small ones of nerfacto's proposals.

    Attributes:
        encoding: position to features.
        layers: hidden layers of the network.
        width: features of each.
        density_activation: ``exp`` stops growing at exp(15).
        density_bias: added before that activation.
        density_per: unit of length of the network's density (see `NeuralSettings`).
    """

    title: ClassVar[str] = "density network"

    encoding: Annotated[Any, Slot("encodings")] = field(
        default_factory=lambda: HashConfig(levels=5, features=2, log2_size=14, base=16, finest=128)
    )
    layers: int = 1
    width: int = 16
    density_activation: Activation = "exp"
    density_bias: float = -1.0
    density_per: Literal["local", "contracted"] = "contracted"

    def __post_init__(self) -> None:
        if self.layers < 0 or self.width < 1:
            raise ValueError("layers cannot be negative, and width must be at least 1.")

    def build(self, scene: Scene) -> DensityField:
        """Build the field for ``scene``'s bounds, its weights drawn from torch's global generator."""
        return DensityField(resolve_encodings(self, scene), scene.bounds)


class DensityField(Field):
    """Density of an encoding by one network; zero outside a box."""

    provides = Quantity.DENSITY
    lo: Tensor
    hi: Tensor

    def __init__(self, config: DensityFieldConfig, bounds: Bounds) -> None:
        super().__init__()
        self.config = config
        self._space: Space = bounds.space
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self._half = float(bounds.half.mean())
        self.encoding = build_encoding(config.encoding, bounds)
        self.net = Mlp(inputs=self.encoding.width, layers=config.layers, width=config.width, outputs=1)
        self.activation = DensityActivation(config.density_activation, config.density_bias)

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`."""
        if Quantity.DENSITY not in want:
            return FieldValues()
        bounds = Bounds(self.lo, self.hi, self._space)
        features = encode_samples(self.encoding, bounds, samples)
        raw = torch.cat([self.net(part)[:, 0] for (part,) in chunks(features)])
        density = self.activation.at_points(raw)
        if self._space == "contracted":
            if self.config.density_per == "contracted":
                density = density * (bounds.radial_scale(samples.position) / self._half)
            return FieldValues(density=density)
        return FieldValues(density=torch.where(bounds.contains(samples.position), density, 0.0))
