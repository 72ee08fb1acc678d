"""Losses: frozen configs that are called with a rendering, its trace, the batch and the context, and return a scalar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Batch, Bounds, Context, Rendering, Trace
from invgraphics.core.compositing import over
from invgraphics.core.spacing import to_spacing
from invgraphics.errors import InputError

Loss = Callable[[Rendering, Trace, Batch, Context], Tensor]
"""A term of the objective. The rendering's ``rgb`` is in front of ``batch.background`` already, composited once per step by
`invgraphics.training.fit.Fit`; its ``alpha`` is still that of the scene alone."""

LEAST_OPACITY = 1e-6
"""Opacities are clamped to this, and to as much below 1, before a logarithm is taken."""

Distance = Literal["mse", "l1", "huber", "charbonnier"]

CHARBONNIER = 0.001
"""Rounding of the charbonnier distance, in colour (mip-NeRF 360)."""


def distance(kind: Distance, prediction: Float[Tensor, "*p 3"], target: Float[Tensor, "*p 3"]) -> Float[Tensor, ""]:
    """Mean over pixels and channels of the squared, absolute, Huber (delta 0.1, as Instant-NGP) or Charbonnier difference."""
    difference = prediction - target
    if kind == "mse":
        return difference.square().mean()
    if kind == "l1":
        return difference.abs().mean()
    if kind == "charbonnier":
        return (difference.square() + CHARBONNIER**2).sqrt().mean()
    return torch.nn.functional.huber_loss(prediction, target, delta=0.1) * 10


@dataclass(frozen=True)
class PhotometricLoss:
    """Colour difference between the composited rendering and the photograph.

    Attributes:
        weight: factor.
        distance: ``mse`` (NeRF), ``l1`` (3DGS), ``huber`` (Instant-NGP) or ``charbonnier`` (mip-NeRF 360).
    """

    weight: float = 1.0
    distance: Distance = "mse"

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted loss."""
        return self.weight * distance(self.distance, rendering.rgb, batch.target)


@dataclass(frozen=True)
class CoarseLoss:
    """NeRF's second term: the squared colour difference of every earlier level that has radiance of its own.

    Attributes:
        weight: factor.
    """

    weight: float = 1.0

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted sum over levels."""
        total = batch.target.new_zeros(())
        for level in trace.levels:
            if level.weights is None or level.samples is None or level.values is None or level.values.radiance is None:
                continue
            weighted = torch.cat([level.weights[:, None] * level.values.radiance, level.weights[:, None]], dim=1)
            sums = weighted.new_zeros(len(batch.target), 4).index_add(0, level.samples.ray, weighted)
            colour = over(sums[:, :3], sums[:, 3], batch.background)
            total = total + (colour - batch.target).square().mean()
        return self.weight * total


@dataclass(frozen=True)
class SsimLoss:
    """1 - SSIM between the composited rendering and the photograph (3DGS, equation 7); needs whole images.

    Attributes:
        weight: factor; 3DGS uses 0.2 beside 0.8 times ``l1``.
    """

    weight: float = 0.2

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted loss.

        Raises:
            InputError: the batch holds single pixels.
        """
        if batch.target.ndim != 3:
            raise InputError(
                "The loss 'ssim' needs whole images, and this renderer draws single rays.",
                "Take it out, for instance by --set 'losses=[{type=\"photometric\"}]'.",
            )
        return self.weight * (1 - kernels.ssim(rendering.rgb, batch.target))


@dataclass(frozen=True)
class DistortionLoss:
    """Mip-NeRF 360's distortion (equation 15): the mean distance between two points of a ray, drawn by its weights.

    It gathers a ray's weight in one place, against floaters. Distances are normalised, see `normalised_distance`.

    Attributes:
        weight: factor; mip-NeRF 360 uses 0.01, nerfacto 0.002.
    """

    weight: float = 0.01

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean over rays; 0 for renderers without samples."""
        samples, weights = trace.samples, trace.weights
        if samples is None or weights is None or len(samples) == 0:
            return batch.target.new_zeros(())
        s0, s1 = (normalised_distance(t, ctx.bounds) for t in (samples.t0, samples.t1))
        middle = (s0 + s1) / 2
        # Σ_ij w_i w_j |m_i - m_j| in O(m) with per-ray prefix sums (Sun et al. 2022, DVGO v2, equation 11).
        before = _prefix(weights, samples.ray)
        before_middle = _prefix(weights * middle, samples.ray)
        pairs = 2 * weights * (middle * before - before_middle)
        within = weights.square() * (s1 - s0) / 3
        return self.weight * (pairs + within).sum() / max(trace.rays, 1)


@dataclass(frozen=True)
class BackgroundEntropyLoss:
    """Entropy of rays' transmittance (DVGO, Sun et al. 2022, equation 12): 0 for rays that are fully opaque or transparent.

    Attributes:
        weight: factor; DVGO uses 0.01 in its coarse stage and 0.001 in the fine one.
    """

    weight: float = 0.001

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean over pixels, in nats."""
        transmittance = (1 - rendering.alpha).clamp(LEAST_OPACITY, 1 - LEAST_OPACITY)
        return self.weight * -(transmittance * transmittance.log() + (1 - transmittance) * (1 - transmittance).log()).mean()


@dataclass(frozen=True)
class PointColourLoss:
    """Squared colour difference of every sample to its pixel, weighed as the sample is (DVGO, equation 11).

    Gradients reach the samples' colours, not their weights.

    Attributes:
        weight: factor; DVGO uses 0.1 in its coarse stage and 0.01 in the fine one.
    """

    weight: float = 0.01

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean over rays of sums over channels; 0 for renderers without samples."""
        samples, values, weights = trace.samples, trace.values, trace.weights
        if samples is None or values is None or values.radiance is None or weights is None:
            return batch.target.new_zeros(())
        squared = (values.radiance - batch.target[samples.ray]).square().sum(dim=1)
        return self.weight * (weights.detach() * squared).sum() / max(trace.rays, 1)


@dataclass(frozen=True)
class MaskLoss:
    """Binary cross-entropy of the opacity with the photographs' alpha (IDR, Yariv et al. 2020, equation 8; NeuS).

    Where the trace holds the logit of the opacity (sphere tracing), the loss is computed from the logit and divided by the
    sigmoid's sharpness per half-extent of the box, as in IDR: its slope in the signed distance then neither grows with the
    sharpness nor vanishes where the opacity saturates. Other opacities are clamped to [1e-6, 1 - 1e-6], where NeuS takes 1e-3:
    a distance's density falls off exponentially, so that the gradient of the logarithm is still large where a surface has
    vanished, and brings it back. The loss is 0 of batches without a transparent pixel, such as those of opaque photographs.

    Attributes:
        weight: factor (IDR: 100; NeuS: 0.1).
    """

    weight: float = 0.1

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean over pixels, in nats; over the sharpness where there is one."""
        clear = batch.alpha < 1
        masked = (clear if batch.mask is None else clear & batch.mask).any()  # stays on the device
        if trace.surface is None:
            alpha = rendering.alpha.clamp(LEAST_OPACITY, 1 - LEAST_OPACITY)
            # Not torch's own, which raises an error of its own on NaN: a fit names the value and keeps its checkpoint.
            entropy = -(batch.alpha * alpha.log() + (1 - batch.alpha) * torch.log1p(-alpha)).mean()
            return self.weight * masked * entropy
        logit, sharpness = trace.surface.logit, trace.surface.sharpness * float(ctx.bounds.half.mean())
        # Rays that miss the bounds are empty whatever the field is, and have a logit that is not finite.
        met = torch.nonzero(logit.isfinite())[:, 0]
        entropy = torch.nn.functional.binary_cross_entropy_with_logits(logit[met], batch.alpha[met], reduction="sum")
        return self.weight / sharpness * masked * entropy / max(len(logit), 1)


@dataclass(frozen=True)
class OpacityLoss:
    """Mean opacity of all Gaussians: those that no photograph needs fade, and can be relocated (3DGS-MCMC).

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
    """Mean standard deviation of all Gaussians along their axes, in local units (3DGS-MCMC, Kheradmand et al. 2024).

    Attributes:
        weight: factor.
    """

    weight: float = 0.01

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean; 0 for renderers without Gaussians on a screen."""
        if trace.screen is None or trace.screen.scales is None or trace.screen.scales.numel() == 0:
            return batch.target.new_zeros(())
        return self.weight * trace.screen.scales.mean()


def normalised_distance(t: Float[Tensor, "*n"], bounds: Bounds) -> Float[Tensor, "*n"]:
    """Distance along a ray in the spacing of `to_spacing`, in units of the longest interval that a ray can have.

    In a box that is distance over the box's diagonal. In a contracted space it is mip-NeRF 360's s (equation 11) with
    nerfacto's spacing: distance up to the bounds' radius and disparity beyond, each over half of [0, 1]. One scale serves all
    rays, so a gap between two surfaces costs the same in the middle of a box as near a corner, where rays are short.
    """
    s = to_spacing(t, bounds)
    return s / (2 * bounds.radius) if bounds.space == "box" else s


def _prefix(values: Float[Tensor, " m"], ray: Int[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Exclusive running sum within each ray of packed samples."""
    total = values.double().cumsum(0)
    exclusive = total - values
    first = torch.ones_like(ray, dtype=torch.bool)
    first[1:] = ray[1:] != ray[:-1]
    start = torch.cummax(torch.where(first, torch.arange(len(ray), device=ray.device), 0), dim=0).values
    return (exclusive - exclusive[start]).to(values.dtype)
