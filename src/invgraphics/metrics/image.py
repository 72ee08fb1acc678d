"""Classical image metrics on display colours: PSNR, SSIM, MS-SSIM."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from invgraphics.metrics.base import Metric, Pair, Skip

PSNR_CAP = 100.0
"""dB of two identical images, whose PSNR would be infinite and spoil every mean."""

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5
"""Half-width of the 11 x 11 window that Wang et al. (2004) use."""

MS_SSIM_SHORTEST = 161
"""Shortest side for five scales of an 11 x 11 window: (11 - 1) * 2**4 + 1."""


def psnr(pair: Pair) -> float:
    """Peak signal-to-noise ratio, -10 log10(MSE) for colours in [0, 1], over the pixels that count; at most `PSNR_CAP`."""
    mse = pair.mean_within((pair.image.double() - pair.truth.double()).square().mean(dim=-1))
    return -10 * math.log10(max(mse, 10 ** (-PSNR_CAP / 10)))


def ssim(pair: Pair) -> float:
    """Structural similarity (Wang et al. 2004): scikit-image with its published settings, channels averaged.

    As in scikit-image, the map's outer 5 pixels, whose windows reach over the edge, are left out of the mean.
    """
    from skimage.metrics import structural_similarity

    height, width = pair.pred_alpha.shape
    if min(height, width) <= 2 * SSIM_RADIUS:
        raise Skip(f"images of {width}x{height} are smaller than SSIM's 11 x 11 window")
    image, truth = (values.double().cpu().numpy() for values in (pair.image, pair.truth))
    settings = {"gaussian_weights": True, "sigma": SSIM_SIGMA, "use_sample_covariance": False, "data_range": 1.0}
    result: Any = structural_similarity(truth, image, channel_axis=-1, full=True, **settings)
    mean, per_pixel = result
    if pair.mask is None:
        return float(mean)
    inner = slice(SSIM_RADIUS, -SSIM_RADIUS)
    mask = pair.mask.cpu().numpy()[inner, inner]
    if not mask.any():
        raise Skip("the view's mask leaves no pixel to score")
    return float(np.mean(per_pixel[inner, inner][mask]))


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
    """Raise `Skip` for a metric that gives one number for a whole image, if some pixels do not count."""
    if pair.mask is not None and not bool(pair.mask.all()):
        raise Skip("the view has a mask, and this metric has no per-pixel map to apply it to")


PSNR = Metric("psnr", "dB", True, psnr, "peak signal-to-noise ratio per view, then mean; identical images count as 100 dB")
SSIM = Metric("ssim", "", True, ssim, "structural similarity: Gaussian 11x11 window, sigma 1.5, range 1, borders left out")
MS_SSIM = Metric("ms_ssim", "", True, ms_ssim, "multi-scale SSIM, five scales; needs 161 pixels along the shorter side")
