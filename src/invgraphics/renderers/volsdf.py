"""VolSDF: volume rendering of a signed distance through Laplace's distribution (Yariv et al. 2021, arXiv 2106.12052)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import Context, Field, Quantity, Scene
from invgraphics.renderers.distance_density import LaplaceDensity
from invgraphics.renderers.error_bounded import ErrorBoundedConfig
from invgraphics.renderers.hybrid import Change, Hybrid, check_settings, least_width, make_volumetric
from invgraphics.renderers.volumetric import Volumetric

DEVIATION = math.sqrt(2)
"""Standard deviation of Laplace's distribution, over β."""


@dataclass(frozen=True)
class VolSDFConfig:
    """Settings of `VolSDF`.

    Attributes:
        sampler: where along the rays to look; ``error_bounded`` is the paper's.
        beta: β, the width of the density at the start, in half-extents of the box.
        beta_final: β at the end where it is scheduled; stands in for a learnt one that the field was not fitted with.
        beta_min: least β (VolSDF: 1e-4).
        min_deviation: least standard deviation of the density's distribution on a schedule, in pixels of the nearest training
            camera over the box (1/√12: that of a pixel's own box); pictures show no sharper edge. 0: none.
        change: whether β is ``learnt``, ``scheduled`` log-linearly over the fit, or ``held``.
        sections: take the density's mean over each interval, along which the SDF is assumed linear, instead of the density at
            its middle (VolSDF: at its start): for even steps, which are longer than a small β.
        gradient_reach: as of volume rendering.
        weight_threshold: in training, samples that weigh no more than this by the sampler's own densities, where it
            has some (``occupancy``), are left out; 0 keeps all.
    """

    title: ClassVar[str] = "hybrid implicit-volumetric"

    sampler: Annotated[Any, Slot("samplers")] = field(default_factory=ErrorBoundedConfig)
    beta: float = 0.1
    beta_final: float = 0.002
    beta_min: float = 1e-4
    min_deviation: float = 0.0
    change: Change = "learnt"
    sections: bool = False
    gradient_reach: float = 0.0
    weight_threshold: float = 0.0

    def __post_init__(self) -> None:
        check_settings(self.beta, self.beta_final, self.min_deviation, self.gradient_reach, self.weight_threshold)
        if not 0 < self.beta_min <= min(self.beta, self.beta_final):
            raise ValueError("beta_min must be above 0, and at most beta and beta_final.")

    @property
    def widths(self) -> tuple[float, float]:
        """β at the start, and the one at the end or in an untrained renderer."""
        return self.beta, self.beta_final

    def to_parameter(self, width: float) -> float:
        """Value of the parameter for a β."""
        return width - self.beta_min

    def to_width(self, parameter: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Inverse of `to_parameter`, and of its negative."""
        return parameter.abs() + self.beta_min

    def build(self, scene: Scene) -> VolSDF:
        """The renderer with its sampler."""
        volumetric = make_volumetric(self.sampler.build(scene), self.gradient_reach, self.weight_threshold)
        return VolSDF(self._resolved(scene), volumetric)

    def _resolved(self, scene: Scene) -> VolSDFConfig:
        """The settings with a schedule that stays as wide as ``min_deviation``."""
        least = least_width(self, DEVIATION, scene)
        return replace(self, beta=max(self.beta, least), beta_final=max(self.beta_final, least))


class VolSDF(Hybrid):
    """Renders Laplace's density."""

    def __init__(self, config: VolSDFConfig, renderer: Volumetric) -> None:
        super().__init__(config, renderer)
        self.config = config

    @property
    @override
    def required(self) -> Quantity:
        return super().required | (Quantity.GRADIENT if self.config.sections else Quantity.NONE)

    @override
    def density(self, field: Field, ctx: Context, *, on_rays: bool = True) -> LaplaceDensity:
        if not (self.config.sections and on_rays):
            return LaplaceDensity(field, self.beta(ctx), "pointwise")
        return LaplaceDensity(field, self.beta(ctx), "neighbours" if ctx.training else "gradient")

    @override
    def untrained(self) -> VolSDF:
        """Copy with ``beta_final``, or a held β, and the sampler's constants in place of learnt state."""
        beta = self.config.beta if self.config.change == "held" else self.config.beta_final
        return VolSDF(replace(self.config, beta=beta, change="held"), self.volumetric.untrained())
