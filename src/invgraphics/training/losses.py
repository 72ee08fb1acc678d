"""Losses: functions of a rendering, its trace and the batch, each a frozen config with a weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Batch, Context, Rendering, Trace
from invgraphics.core.compositing import over

Loss = Callable[[Rendering, Trace, Batch, Context], Tensor]

Distance = Literal["mse", "l1", "huber"]

_pictures: WeakKeyDictionary[Rendering, tuple[Tensor, Tensor]] = WeakKeyDictionary()


def picture_of(rendering: Rendering, batch: Batch) -> Float[Tensor, "*p 3"]:
    """The rendering in front of its batch's background; made once for all losses of a step."""
    background, picture = _pictures.get(rendering, (None, batch.background))
    if background is not batch.background:
        picture = rendering.over(batch.background)
        _pictures[rendering] = batch.background, picture
    return picture


def distance(kind: Distance, prediction: Float[Tensor, "*p 3"], target: Float[Tensor, "*p 3"]) -> Float[Tensor, ""]:
    """Mean over pixels and channels of the squared, absolute or Huber (delta 0.1, as Instant-NGP) difference."""
    difference = prediction - target
    if kind == "mse":
        return difference.square().mean()
    if kind == "l1":
        return difference.abs().mean()
    return torch.nn.functional.huber_loss(prediction, target, delta=0.1) * 10


@dataclass(frozen=True)
class PhotometricConfig:
    """Colour difference between the picture, in front of the batch's background, and the photograph.

    Attributes:
        weight: factor.
        distance: ``mse`` (NeRF), ``l1`` (3DGS) or ``huber`` (Instant-NGP).
    """

    weight: float = 1.0
    distance: Distance = "mse"

    def build(self) -> Loss:
        """The loss as a function."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            return self.weight * distance(self.distance, picture_of(rendering, batch), batch.target)

        return loss


@dataclass(frozen=True)
class CoarseConfig:
    """NeRF's second term: the colour difference of every earlier level that knows its own radiance.

    Attributes:
        weight: factor.
    """

    weight: float = 1.0

    def build(self) -> Loss:
        """The loss as a function."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            total = batch.target.new_zeros(())
            for level in trace.levels:
                if level.weights is None or level.samples is None or level.values is None or level.values.radiance is None:
                    continue
                weighted = torch.cat([level.weights[:, None] * level.values.radiance, level.weights[:, None]], dim=1)
                sums = weighted.new_zeros(len(batch.target), 4).index_add(0, level.samples.ray, weighted)
                colour = over(sums[:, :3], sums[:, 3], batch.background)
                total = total + (colour - batch.target).square().mean()
            return self.weight * total

        return loss


@dataclass(frozen=True)
class SsimConfig:
    """1 - SSIM between picture and photograph (3DGS, equation 7); needs whole images.

    Attributes:
        weight: factor; 3DGS uses 0.2 beside 0.8 times ``l1``.
    """

    weight: float = 0.2

    def build(self) -> Loss:
        """The loss as a function."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            return self.weight * (1 - kernels.ssim(picture_of(rendering, batch), batch.target))

        return loss


@dataclass(frozen=True)
class DistortionConfig:
    """Mip-NeRF 360's distortion (equation 15): gathers a ray's weight in one place, against floaters.

    Distances are normalised per ray to [0, 1] over its interval (linear in disparity when contracted).

    Attributes:
        weight: factor; mip-NeRF 360 uses 0.01, nerfacto 0.002.
    """

    weight: float = 0.01

    def build(self) -> Loss:
        """The loss as a function."""

        def loss(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Tensor:
            samples, weights = trace.samples, trace.weights
            if samples is None or weights is None or len(samples) == 0:
                return batch.target.new_zeros(())
            scale = ctx.bounds.radius
            s0, s1 = ((t / (t + scale)) for t in (samples.t0, samples.t1))
            middle = (s0 + s1) / 2
            # sum_ij w_i w_j |m_i - m_j| in O(m) with per-ray prefix sums (Sun et al. 2022, DVGO v2, equation 11).
            before = _prefix(weights, samples.ray)
            before_middle = _prefix(weights * middle, samples.ray)
            pairs = 2 * weights * (middle * before - before_middle)
            selves = weights.square() * (s1 - s0) / 3
            return self.weight * (pairs + selves).sum() / max(trace.rays, 1)

        return loss


def _prefix(values: Float[Tensor, " m"], ray: Tensor) -> Float[Tensor, " m"]:
    """Exclusive running sum within each ray of packed samples."""
    total = values.double().cumsum(0)
    exclusive = total - values
    first = torch.ones_like(ray, dtype=torch.bool)
    first[1:] = ray[1:] != ray[:-1]
    start = torch.cummax(torch.where(first, torch.arange(len(ray), device=ray.device), 0), dim=0).values
    return (exclusive - exclusive[start]).to(values.dtype)
