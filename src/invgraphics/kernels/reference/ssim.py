"""Structural similarity as a loss."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
"""Stabilisers (K1 L)² and (K2 L)² of Wang et al. 2004, equation 13, for the data range L = 1."""


def ssim(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """See `invgraphics.kernels.ssim`."""
    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x.square()
    variance_y = _blur(y * y) - mean_y.square()
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x.square() + mean_y.square() + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)
    return (luminance * structure).mean()


def _blur(planes: Float[Tensor, "c 1 h w"]) -> Float[Tensor, "c 1 h w"]:
    """Gaussian weighted local mean, zeros outside; the window is separable, so rows come first and columns after."""
    offset = torch.arange(WINDOW, dtype=planes.dtype, device=planes.device) - WINDOW // 2
    window = torch.exp(-0.5 * (offset / SIGMA) ** 2)
    window = window / window.sum()
    across = conv2d(planes, window.view(1, 1, 1, WINDOW), padding=(0, WINDOW // 2))
    return conv2d(across, window.view(1, 1, WINDOW, 1), padding=(WINDOW // 2, 0))
