"""Scoring under the conventions of other tools: compositing, rounding, PSNR, SSIM and LPIPS as each of them does it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb, quantise
from invgraphics.metrics.base import Skip
from invgraphics.metrics.conventions import Convention, Lpips, Measure, Psnr, Rounding, Ssim
from invgraphics.metrics.image import PSNR_CAP, SSIM_RADIUS, SSIM_SIGMA
from invgraphics.metrics.perceptual import lpips_distance
from invgraphics.metrics.protocols import ViewScore, join_views

Image = Float[Tensor, "h w 3"]

LUMA = (0.2126, 0.7152, 0.0722)
"""Rec. 709 weights of red, green and blue, applied to display values as instant-ngp does."""

K1, K2 = 0.01, 0.03
"""SSIM's constants, as published and as every tool uses them."""


def score_under(rendering: Rendering, view: View, scene: Scene, convention: Convention) -> ViewScore:
    """Score one view under another tool's convention.

    Args:
        rendering: the prediction, of the view's size, in the scene's colour space.
        view: the truth.
        scene: where both come from; its background is used where the convention says so, and where nothing is transparent.
        convention: how to measure.
    """
    values: dict[str, float] = {}
    skipped: dict[str, str] = {}
    try:
        image, truth = shown(rendering, view, scene, convention)
    except Skip as reason:
        return ViewScore(view.name, {}, dict.fromkeys(convention.measures, str(reason)))
    for name, how in convention.measures.items():
        try:
            values[name] = measure(how, image, truth)
        except Skip as reason:
            skipped[name] = str(reason)
    return ViewScore(view.name, values, skipped)


def shown(rendering: Rendering, view: View, scene: Scene, convention: Convention) -> tuple[Image, Image]:
    """Prediction and truth as the tool compares them: display sRGB in [0, 1], composited, rounded, masked.

    Raises:
        Skip: the prediction is not finite somewhere, or the view has a mask and the tool knows none.
    """
    broken = ~(rendering.rgb.isfinite().all(dim=-1) & rendering.alpha.isfinite())
    if broken.any():
        raise Skip(f"the predicted colour or alpha is not finite at {int(broken.sum())} of {broken.numel()} pixels")
    background = scene.background
    if view.alpha is not None and convention.background != "scene":
        background = torch.tensor(convention.background)
    to_display = linear_to_srgb if scene.colour == "linear" else lambda colour: colour.clamp(0, 1)
    image = rounded(to_display(rendering.over(background.to(rendering.rgb))), convention.prediction)
    true_colour = _over_in_double if convention.truth_double and view.image.dtype == torch.uint8 else View.over
    truth = rounded(to_display(true_colour(view, background.to(torch.float32))), convention.truth).to(image)
    if view.mask is not None and not bool(view.mask.all()):
        if convention.masks == "unknown":
            raise Skip(f"the view has a mask, and {convention.name} knows no masks")
        counted = view.mask.to(image)[..., None]
        image, truth = image * counted, truth * counted
    return image, truth


def _over_in_double(view: View, background: Float[Tensor, 3]) -> Float[Tensor, "h w 3"]:
    """`View.over` for bytes, in double precision."""
    if view.alpha is None:
        return view.image.double() / 255
    alpha = view.alpha[..., None].double() / 255
    return view.image.double() / 255 * alpha + (1 - alpha) * background.double()


def rounded(display: Image, rounding: Rounding) -> Image:
    """Display colours in [0, 1] after an image file of 8 bits, or as they are."""
    if rounding == "none":
        return display
    levels = quantise(display) if rounding == "nearest" else (display.clamp(0, 1) * 255).to(torch.uint8)
    return levels.float() / 255


def measure(how: Measure, image: Image, truth: Image) -> float:
    """One number for one pair of pictures.

    Args:
        how: what to measure, and with which settings.
        image: the prediction, display colours in [0, 1].
        truth: the truth, likewise.

    Raises:
        Skip: the pictures are too small, or LPIPS lacks its weights.
    """
    if isinstance(how, Psnr):
        return psnr(how, image, truth)
    if isinstance(how, Ssim):
        return ssim(how, image, truth)
    return lpips_distance(image, truth, how.net, how.scaled)


def psnr(how: Psnr, image: Image, truth: Image) -> float:
    """-10 log10(MSE) in dB; infinite values count as `PSNR_CAP`."""
    errors = (image.double() - truth.double()).square().mean(dim=(0, 1))
    channels = errors if how.channels == "apart" else errors.mean()[None]
    return float((-10 * channels.clamp_min(10 ** (-PSNR_CAP / 10)).log10()).mean())


def ssim(how: Ssim, image: Image, truth: Image) -> float:
    """Mean of the SSIM map (Wang et al. 2004, eq. 13) over pixels and channels, in double precision."""
    kernel = np.asarray(how.kernel or gaussian_kernel())
    radius, (height, width) = len(kernel) // 2, truth.shape[:2]
    if min(height, width) < len(kernel):
        raise Skip(f"images of {width}x{height} are smaller than SSIM's window of {len(kernel)} x {len(kernel)}")
    x, y = (values.double().cpu().numpy() for values in (image, truth))
    data_range = max(np.ptp(x), np.ptp(y)) if how.data_range is None else how.data_range
    if how.grey:
        x, y = x @ np.asarray(LUMA), y @ np.asarray(LUMA)
    blur = _blur(kernel, how.edges)
    mean_x, mean_y = blur(x), blur(y)
    variances = blur(x * x) - mean_x**2 + blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    numerator = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    denominator = (mean_x**2 + mean_y**2 + c1) * (variances + c2)
    # Two pictures of one and the same colour have no range of their own: they are equal or not comparable at all.
    similarity = np.divide(numerator, denominator, out=np.ones_like(numerator), where=denominator != 0)
    inner = slice(radius, -radius) if how.edges == "valid" else slice(None)
    return float(similarity[inner, inner].mean())


def gaussian_kernel() -> Float[np.ndarray, " taps"]:
    """The published window along one axis: 11 taps of a Gaussian with sigma 1.5, sum 1."""
    weights = np.exp(-0.5 * (np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) / SSIM_SIGMA) ** 2)
    return weights / weights.sum()


def _blur(kernel: np.ndarray, edges: str) -> Callable[[np.ndarray], np.ndarray]:
    from scipy.ndimage import correlate1d

    # Windows that reach over the edge are dropped afterwards where only whole ones count, so any continuation will do.
    mode = {"zero": "constant", "mirror": "mirror"}.get(edges, "reflect")
    return lambda values: correlate1d(correlate1d(values, kernel, axis=0, mode=mode), kernel, axis=1, mode=mode)


def summarise_under(scores: Sequence[ViewScore], convention: Convention) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Join the views into the ``quality`` and the ``skipped`` part of a ``scores.json``, as the tool joins them."""

    def joined(name: str, values: list[float]) -> dict[str, Any]:
        how = convention.measures[name]
        mean = math.fsum(values) / len(values)
        if isinstance(how, Psnr) and how.views == "mean error":
            mean = -10 * math.log10(math.fsum(10 ** (-value / 10) for value in values) / len(values))
        unit = "dB" if isinstance(how, Psnr) else ""
        return {"mean": mean, "unit": unit, "higher_is_better": not isinstance(how, Lpips)}

    return join_views(scores, joined)
