"""Classical image metrics on display colours: PSNR, SSIM, MS-SSIM."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.metrics.base import Metric, Pair, Skip
from invgraphics.metrics.conventions import Psnr, Ssim

Channel = Float[np.ndarray, "h w"]

PSNR_CAP = 100.0
"""dB of two identical images, whose PSNR would be infinite and spoil every mean."""

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5
"""Half-width of the 11 x 11 window that Wang et al. (2004) use."""

K1, K2 = 0.01, 0.03
"""SSIM's constants, as published and as every tool uses them."""

LUMA = (0.2126, 0.7152, 0.0722)
"""Rec. 709 weights of red, green and blue, applied to display values as instant-ngp does."""

_PSNR, _SSIM = Psnr(), Ssim()

MS_SSIM_SHORTEST = 161
"""Shortest side for five scales of an 11 x 11 window: (11 - 1) * 2**4 + 1."""


def psnr(pair: Pair, how: Psnr = _PSNR) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10(MSE) for colours in [0, 1], over unmasked pixels; at most `PSNR_CAP`."""
    squared = (pair.image.double() - pair.truth.double()).square()
    channels = squared.unbind(dim=-1) if how.channels == "apart" else (squared.mean(dim=-1),)
    values = [-10 * math.log10(max(pair.mean_within(errors), 10 ** (-PSNR_CAP / 10))) for errors in channels]
    return sum(values) / len(values)


def ssim(pair: Pair, how: Ssim = _SSIM) -> float:
    """Mean of the SSIM map (Wang et al. 2004, eq. 13) over unmasked pixels and channels, in double precision."""
    kernel = np.asarray(how.kernel or gaussian_kernel())
    radius, (height, width) = len(kernel) // 2, pair.truth.shape[:2]
    if min(height, width) < len(kernel):
        raise Skip(f"images of {width}x{height} are smaller than SSIM's {len(kernel)} x {len(kernel)} window")
    image, truth = (values.double().cpu().numpy() for values in (pair.image, pair.truth))
    data_range = max(np.ptp(image), np.ptp(truth)) if how.data_range is None else how.data_range
    if how.grey:
        image, truth = (values @ np.asarray(LUMA) for values in (image, truth))
    channels = zip(np.atleast_3d(image).transpose(2, 0, 1), np.atleast_3d(truth).transpose(2, 0, 1), strict=True)
    constants = ((K1 * data_range) ** 2, (K2 * data_range) ** 2)
    inner = slice(radius, -radius) if how.edges == "valid" else slice(None)
    maps = [_similarity(x, y, _blur(kernel, how.edges), constants)[inner, inner] for x, y in channels]
    if pair.mask is None:
        return float(np.mean([values.mean() for values in maps]))
    mask = pair.mask.cpu().numpy()[inner, inner]
    if not mask.any():
        raise Skip("the view's mask leaves no pixel to score")
    return float(np.mean(np.stack(maps, axis=-1)[mask]))


def _similarity(x: Channel, y: Channel, blur: Callable[[Channel], Channel], constants: tuple[float, float]) -> Channel:
    """SSIM of one channel at every pixel."""
    mean_x, mean_y = blur(x), blur(y)
    variances = (blur(x * x) - mean_x * mean_x) + (blur(y * y) - mean_y * mean_y)
    covariance = blur(x * y) - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + constants[0]) * (2 * covariance + constants[1])
    denominator = (mean_x**2 + mean_y**2 + constants[0]) * (variances + constants[1])
    # Two pictures of one and the same colour have no range of their own: they are equal or not comparable at all.
    return np.divide(numerator, denominator, out=np.ones_like(numerator), where=denominator != 0)


def gaussian_kernel() -> Float[np.ndarray, " taps"]:
    """SSIM's published window along one axis: 11 taps of a Gaussian with sigma 1.5, sum 1."""
    weights = np.exp(-0.5 / SSIM_SIGMA**2 * np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) ** 2)
    return weights / weights.sum()


def _blur(kernel: np.ndarray, edges: str) -> Callable[[Channel], Channel]:
    from scipy.ndimage import correlate1d

    # Windows that reach over the edge are dropped afterwards where only whole ones count, so any continuation will do.
    mode = {"zero": "constant", "mirror": "mirror"}.get(edges, "reflect")
    return lambda values: correlate1d(correlate1d(values, kernel, axis=0, mode=mode), kernel, axis=1, mode=mode)


def ms_ssim(pair: Pair) -> float:
    """Multi-scale structural similarity (Wang et al. 2003), five scales, by pytorch-msssim."""
    from pytorch_msssim import ms_ssim as compute

    height, width = pair.pred_alpha.shape
    if min(height, width) < MS_SSIM_SHORTEST:
        raise Skip(f"needs {MS_SSIM_SHORTEST} pixels along the shorter side, the images are {width}x{height}")
    refuse_mask(pair)
    image, truth = (values.double().permute(2, 0, 1)[None] for values in (pair.image, pair.truth))
    with torch.no_grad():
        return float(compute(image, truth, data_range=1.0))


def refuse_mask(pair: Pair) -> None:
    """Raise `Skip` if some pixels are masked, for a metric without a per-pixel map."""
    if pair.mask is not None and not bool(pair.mask.all()):
        raise Skip("the view has a mask, and this metric has no per-pixel map to apply it to")


PSNR = Metric("psnr", "dB", True, psnr, "peak signal-to-noise ratio per view, then mean; identical images count as 100 dB")
SSIM = Metric("ssim", "", True, ssim, "structural similarity: Gaussian 11x11 window, sigma 1.5, range 1, borders left out")
MS_SSIM = Metric("ms_ssim", "", True, ms_ssim, "multi-scale SSIM, five scales; needs 161 pixels along the shorter side")
