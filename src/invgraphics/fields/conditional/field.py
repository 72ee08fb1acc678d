"""A field over a class of objects: one network for all, and a code for each of them, learnt together (auto-decoding).

Bojanowski et al. 2018; Park et al. 2019 (DeepSDF), §4; Sitzmann et al. 2019 (SRN), §3.3. An unseen instance is inferred by
optimising its code alone (`invgraphics.training.codes.inference`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize, softplus
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core.bounds import Bounds, Space
from invgraphics.core.field import Conditional, Quantity
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.errors import InputError
from invgraphics.fields.conditional.layers import Conditioning, make_layer
from invgraphics.fields.encoded import build_encoding, encode_samples, resolve_encodings
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.mlp import truncated_exp

CODE_SPREAD = 0.1
"""Standard deviation of a new code's components."""


@dataclass(frozen=True)
class ConditionalFieldConfig:
    """A network over an encoding of position whose layers depend on a code; a scene of one subject has one code.

    Attributes:
        encoding: position to the network's inputs.
        conditioning: how layers depend on the code: ``hypernetwork`` (SRN), ``concatenation`` (DeepSDF) or ``film`` (pi-GAN).
        code: components of a code (SRN: 256).
        hidden: width of the networks of the code.
        layers: layers of the network, each with layer normalisation and ReLU.
        width: features of each but the last.
        features: of the last.
        head: ``none``: features are what the field provides; ``density``: also density and radiance, linear in the features
            before their activations.
    """

    title: ClassVar[str] = "network over a class"

    encoding: Annotated[Any, Slot("encodings")] = field(default_factory=lambda: FrequencyConfig(octaves=1))
    conditioning: Conditioning = "hypernetwork"
    code: int = 64
    hidden: int = 64
    layers: int = 3
    width: int = 64
    features: int = 64
    head: Literal["none", "density"] = "none"

    def __post_init__(self) -> None:
        if min(self.code, self.hidden, self.layers, self.width, self.features) < 1:
            raise ValueError("code, hidden, layers, width and features must be at least 1.")

    def build(self, scene: Scene) -> ConditionalField:
        """Build the field for ``scene``'s bounds and the subjects of its training views, weights from torch's generator."""
        shown = [view.subject or 0 for view in scene.train]
        subjects = sorted(set(shown))
        rows = torch.tensor([subjects.index(subject) for subject in shown])
        codes = CODE_SPREAD * torch.randn(len(subjects), self.code)
        return ConditionalField(
            ConditionalNetwork(resolve_encodings(self, scene), scene.bounds, scene.colour), codes, rows, tuple(subjects)
        )


class ConditionalNetwork(nn.Module):
    """What the instances of a class share: encoding, layers and head."""

    lo: Tensor
    hi: Tensor

    def __init__(self, config: ConditionalFieldConfig, bounds: Bounds, colour: Literal["srgb", "linear"]) -> None:
        super().__init__()
        self.config, self.colour = config, colour
        self._space: Space = bounds.space
        self._near = bounds.near
        self.register_buffer("lo", bounds.lo.clone())
        self.register_buffer("hi", bounds.hi.clone())
        self.encoding = build_encoding(config.encoding, bounds)
        widths = [self.encoding.width] + [config.width] * (config.layers - 1) + [config.features]
        self.layers = nn.ModuleList(
            make_layer(config.conditioning, before, after, config.code, config.hidden) for before, after in pairwise(widths)
        )
        self.head = nn.Linear(config.features, 4) if config.head == "density" else None

    @property
    def bounds(self) -> Bounds:
        """The region the field describes."""
        return Bounds(self.lo, self.hi, self._space, self._near)

    def features(self, samples: Samples, codes: Float[Tensor, "s c"], row: Int[Tensor, " m"]) -> Float[Tensor, "m f"]:
        """Features of m samples, of which each shows the instance of its ``row`` of ``codes``."""
        x = encode_samples(self.encoding, self.bounds, samples)
        if len(x) == 0:
            return x[:, :1].expand(-1, self.config.features)
        used, index = torch.unique(row, return_inverse=True)
        place, longest = _places(index, len(used))
        grouped = x.new_zeros(len(used) * longest, x.shape[1]).index_copy(0, place, x).unflatten(0, (len(used), longest))
        chosen = codes[used]
        for layer in self.layers:
            grouped = layer(grouped, chosen)
        return grouped.flatten(0, 1)[place]


def _places(index: Int[Tensor, " m"], groups: int) -> tuple[Int[Tensor, " m"], int]:
    """Flat place of each item in a table with a row per group, as wide as the largest group; and that width."""
    counts = torch.bincount(index, minlength=groups)
    longest = int(counts.max())
    order = torch.argsort(index, stable=True)
    rank = torch.arange(len(index), device=index.device) - (counts.cumsum(0) - counts)[index[order]]
    return torch.empty_like(index).index_copy(0, order, index[order] * longest + rank), longest


class ConditionalField(Conditional):
    """Features, or density and radiance, of the instances of a class.

    Args:
        network: what they share.
        codes: start of the learnt codes.
        rows: which of them each training view shows.
        subjects: numbers of the instances in the scene, in the order of ``codes``; empty for instances without numbers.
    """

    rows: Tensor

    def __init__(
        self,
        network: ConditionalNetwork,
        codes: Float[Tensor, "s c"],
        rows: Int[Tensor, " v"],
        subjects: tuple[int | None, ...] = (),
    ) -> None:
        super().__init__()
        self.network, self.subjects = network, subjects
        self.codes = nn.Parameter(codes)
        self.register_buffer("rows", rows, persistent=False)
        with_head = Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL
        self.provides = Quantity.FEATURES | (with_head if network.head is not None else Quantity.NONE)

    @property
    @override
    def feature_width(self) -> int:
        return self.network.config.features

    @override
    def at(self, code: Float[Tensor, " c"]) -> ConditionalField:
        return self.with_codes(code[None], self.rows[:0])

    @override
    def of_subject(self, subject: int) -> ConditionalField:
        if subject not in self.subjects:
            raise InputError(
                f"The class has no training instance {subject}.", f"Known: {self.subjects[0]} to {self.subjects[-1]}."
            )
        return self.at(self.codes[self.subjects.index(subject)].detach())

    @override
    def with_codes(self, codes: Float[Tensor, "k c"], rows: Int[Tensor, " v"]) -> ConditionalField:
        return ConditionalField(self.network, codes.detach().clone(), rows)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; normals are the normalised gradient of minus the density's logarithm, also inside ``no_grad``."""
        if Quantity.NORMAL not in want:
            return self._query(samples, want)
        training = torch.is_grad_enabled()
        with torch.enable_grad():
            moving = samples.position if samples.position.requires_grad else samples.position.detach().requires_grad_()
            features = self._features(_moved(samples, moving))
            raw = self._raw(features)
            (gradient,) = torch.autograd.grad(raw[:, 0].sum(), moving, create_graph=training)
        values = self._values(features, raw, want)
        values = FieldValues(
            values.density, radiance=values.radiance, normal=normalize(-gradient, dim=1), features=values.features
        )
        return values if training else _detached(values)

    def _query(self, samples: Samples, want: Quantity) -> FieldValues:
        if not want & self.provides:
            return FieldValues()
        features = self._features(samples)
        pointwise = want & (Quantity.DENSITY | Quantity.RADIANCE)
        return self._values(features, self._raw(features) if pointwise else None, want)

    def _features(self, samples: Samples) -> Float[Tensor, "m f"]:
        known = samples.view >= 0
        if len(self.rows) == 0 or not bool(known.any()):
            row, codes = torch.zeros_like(samples.view), self.mean_code()[None]
        else:
            row = torch.where(known, self.rows[samples.view.clamp_min(0)], len(self.codes))
            codes = self.codes if bool(known.all()) else torch.cat([self.codes, self.mean_code()[None]])
        return self.network.features(samples, codes, row)

    def _raw(self, features: Float[Tensor, "m f"]) -> Float[Tensor, "m 4"]:
        assert self.network.head is not None, "the check of the pair has seen what the field provides"
        return self.network.head(features)

    def _values(self, features: Tensor, raw: Tensor | None, want: Quantity) -> FieldValues:
        density = radiance = None
        if raw is not None and Quantity.DENSITY in want:
            density = truncated_exp(raw[:, 0])
        if raw is not None and Quantity.RADIANCE in want:
            radiance = raw[:, 1:].sigmoid() if self.network.colour == "srgb" else softplus(raw[:, 1:])
        return FieldValues(density, radiance=radiance, features=features if Quantity.FEATURES in want else None)


def _moved(samples: Samples, position: Float[Tensor, "m 3"]) -> Samples:
    return Samples(samples.ray, samples.t0, samples.t1, position, samples.direction, samples.radius, samples.view)


def _detached(values: FieldValues) -> FieldValues:
    return FieldValues(**{name: None if value is None else value.detach() for name, value in vars(values).items()})
