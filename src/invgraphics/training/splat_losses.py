"""Losses on the primitives themselves rather than on the picture (3DGS-MCMC, Kheradmand et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from invgraphics.core import Batch, Context, Rendering, Trace
from invgraphics.training.losses import Loss


@dataclass(frozen=True)
class OpacityConfig:
    """Mean opacity of all primitives: what is not needed fades, and can be relocated.

    Attributes:
        weight: factor.
    """

    weight: float = 0.01

    def build(self) -> Loss:
        """The loss as a function; 0 for renderers without primitives on a screen."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            if trace.screen is None or trace.screen.opacities is None or trace.screen.opacities.numel() == 0:
                return batch.target.new_zeros(())
            return self.weight * trace.screen.opacities.mean()

        return loss


@dataclass(frozen=True)
class ScaleConfig:
    """Mean standard deviation of all primitives along their axes, in local units.

    Attributes:
        weight: factor.
    """

    weight: float = 0.01

    def build(self) -> Loss:
        """The loss as a function; 0 for renderers without primitives on a screen."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            if trace.screen is None or trace.screen.scales is None or trace.screen.scales.numel() == 0:
                return batch.target.new_zeros(())
            return self.weight * trace.screen.scales.mean()

        return loss
