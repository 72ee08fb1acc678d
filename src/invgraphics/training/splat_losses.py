"""Losses on the Gaussians themselves rather than on the rendering (3DGS-MCMC, Kheradmand et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Batch, Context, Rendering, Trace


@dataclass(frozen=True)
class OpacityLoss:
    """Mean opacity of all Gaussians: those that no photograph needs fade, and can be relocated.

    Attributes:
        weight: factor.
    """

    weight: float = 0.01

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean; 0 for renderers without Gaussians on a screen."""
        if trace.screen is None or trace.screen.opacities is None or trace.screen.opacities.numel() == 0:
            return batch.target.new_zeros(())
        return self.weight * trace.screen.opacities.mean()


@dataclass(frozen=True)
class ScaleLoss:
    """Mean standard deviation of all Gaussians along their axes, in local units.

    Attributes:
        weight: factor.
    """

    weight: float = 0.01

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean; 0 for renderers without Gaussians on a screen."""
        if trace.screen is None or trace.screen.scales is None or trace.screen.scales.numel() == 0:
            return batch.target.new_zeros(())
        return self.weight * trace.screen.scales.mean()
