"""NeuS: volume rendering of a signed distance by unbiased weights (Wang et al. 2021, arXiv 2106.10689)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import Context, Field, Quantity, Scene
from invgraphics.renderers.distance_density import LogisticDensity
from invgraphics.renderers.hybrid import Change, Hybrid, check_settings, least_width, make_volumetric
from invgraphics.renderers.up_sampling import UpSamplingConfig
from invgraphics.renderers.volumetric import Volumetric

DEVIATION = math.pi / math.sqrt(3)
"""Standard deviation of the logistic distribution, over 1 / s."""
EXPONENT = 10.0
"""The parameter of s is v = log(s) / 10 (NeuS, its code): a step of the optimiser multiplies s."""


@dataclass(frozen=True)
class NeuSConfig:
    """Settings of `NeuS`.

    Attributes:
        sampler: where along the rays to look; ``up_sampling`` is the paper's.
        sharpness: s of the logistic distribution at the start, per half-extent of the box (NeuS: exp(3) = 20).
        sharpness_final: s at the end where it is scheduled; stands in for a learnt one that the field was not fitted with.
        change: whether s is ``learnt``, ``scheduled`` log-linearly over the fit, or ``held``.
        min_deviation: least standard deviation of the density's distribution on a schedule, in pixels of the nearest training
            camera over the box (1/√12: that of a pixel's own box); pictures show no sharper edge. 0: none.
        anneal: progress until which rays see surfaces that they leave too, less and less (NeuS without masks: 1/6).
        gradient_reach: as of volume rendering.
        weight_threshold: in training, samples that weigh no more than this by the sampler's own densities, where it
            has some (``occupancy``), are left out; 0 keeps all.
    """

    title: ClassVar[str] = "hybrid implicit-volumetric"

    sampler: Annotated[Any, Slot("samplers")] = field(default_factory=UpSamplingConfig)
    sharpness: float = 20.0
    sharpness_final: float = 1000.0
    change: Change = "learnt"
    min_deviation: float = 0.0
    anneal: float = 0.0
    gradient_reach: float = 0.0
    weight_threshold: float = 0.0

    def __post_init__(self) -> None:
        check_settings(self.sharpness, self.sharpness_final, self.min_deviation, self.gradient_reach, self.weight_threshold)
        if not 0 <= self.anneal <= 1:
            raise ValueError(f"anneal must be in [0, 1], not {self.anneal}")

    @property
    def widths(self) -> tuple[float, float]:
        """1 / s at the start, and the one at the end or in an untrained renderer."""
        return 1 / self.sharpness, 1 / self.sharpness_final

    def to_parameter(self, width: float) -> float:
        """Value of the parameter for a 1 / s."""
        return -math.log(width) / EXPONENT

    def to_width(self, parameter: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Inverse of `to_parameter`."""
        return (-EXPONENT * parameter).exp()

    def build(self, scene: Scene) -> NeuS:
        """The renderer with its sampler."""
        volumetric = make_volumetric(self.sampler.build(scene), self.gradient_reach, self.weight_threshold)
        return NeuS(self._resolved(scene), volumetric)

    def _resolved(self, scene: Scene) -> NeuSConfig:
        """The settings with a schedule that stays as wide as ``min_deviation``."""
        least = least_width(self, DEVIATION, scene)
        most = 1 / least if least else math.inf
        return replace(self, sharpness=min(self.sharpness, most), sharpness_final=min(self.sharpness_final, most))


class NeuS(Hybrid):
    """Renders the logistic density, section by section."""

    requires: ClassVar[Quantity] = Hybrid.requires | Quantity.GRADIENT

    def __init__(self, config: NeuSConfig, renderer: Volumetric) -> None:
        super().__init__(config, renderer)
        self.config = config

    @override
    def density(self, field: Field, ctx: Context, *, on_rays: bool = True) -> LogisticDensity:
        anneal = 1.0 if self.config.anneal == 0 else min(1.0, ctx.progress / self.config.anneal)
        if not on_rays:
            return LogisticDensity(field, self.beta(ctx), "steepest", anneal)
        return LogisticDensity(field, self.beta(ctx), "neighbours" if ctx.training else "gradient", anneal)

    @override
    def untrained(self) -> NeuS:
        """Copy with ``sharpness_final``, or a held s, and the sampler's constants in place of learnt state."""
        sharpness = self.config.sharpness if self.config.change == "held" else self.config.sharpness_final
        return NeuS(replace(self.config, sharpness=sharpness, change="held"), self.volumetric.untrained())
