"""Fields of features without a density, for renderers that learn how to aggregate them (SRN, Sitzmann et al. 2019)."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, ClassVar

from torch import Tensor, nn
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Field, Quantity
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.fields.encoded import build_encoding, encode_samples, resolve_encodings
from invgraphics.fields.encodings.frequency import FrequencyConfig


@dataclass(frozen=True)
class FeatureFieldConfig:
    """A network over an encoding of position that outputs features alone.

    Attributes:
        encoding: position to the network's inputs; SRN takes coordinates as they are (``frequency`` with 0 octaves).
        layers: linear layers, each followed by layer normalisation and ReLU (SRN: 4).
        width: features of each but the last (SRN: 256).
        features: of the last, which are the field's (SRN: 256).
    """

    title: ClassVar[str] = "network"

    encoding: Annotated[Any, Slot("encodings")] = field(default_factory=FrequencyConfig)
    layers: int = 4
    width: int = 256
    features: int = 256

    def __post_init__(self) -> None:
        if min(self.layers, self.width, self.features) < 1:
            raise ValueError("layers, width and features must be at least 1.")

    def build(self, scene: Scene) -> FeatureField:
        """Build the field for ``scene``'s bounds, its weights drawn from torch's global generator."""
        return FeatureField(resolve_encodings(self, scene), scene.bounds)


class FeatureField(Field):
    """Features of a position: no density, no surface, no colour.

    Attributes:
        encoding: of positions in the unit cube.
        net: layers of a linear map, layer normalisation and ReLU.
    """

    provides = Quantity.FEATURES
    lo: Tensor
    hi: Tensor

    def __init__(self, config: FeatureFieldConfig, bounds: Bounds) -> None:
        super().__init__()
        self._space: Space = bounds.space
        self._near = bounds.near
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self.encoding = build_encoding(config.encoding, bounds)
        widths = [self.encoding.width] + [config.width] * (config.layers - 1) + [config.features]
        layers = [nn.Sequential(nn.Linear(before, after), nn.LayerNorm(after), nn.ReLU()) for before, after in pairwise(widths)]
        self.net = nn.Sequential(*layers)
        self._width = config.features

    @property
    def bounds(self) -> Bounds:
        """The region this field describes."""
        return Bounds(self.lo, self.hi, self._space, self._near)

    @property
    @override
    def feature_width(self) -> int:
        return self._width

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Features of the samples' positions, (m, features); see `Field.query`."""
        if Quantity.FEATURES not in want:
            return FieldValues()
        return FieldValues(features=self.net(encode_samples(self.encoding, self.bounds, samples)))
