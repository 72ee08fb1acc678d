"""PSNR that leaves out exposure: fitted on one half of the photograph, and scored on the other half."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from invgraphics.metrics.base import Inapplicable, Metric, Pair, Skip
from invgraphics.metrics.image import psnr

FEWEST = 64
"""Fewest pixels of a half."""


def psnr_exposed(pair: Pair) -> float:
    """PSNR in dB of the right half, each colour channel times the factor that fits the left half best.

    The halves are NeRF-W's for photographs of unknown exposure. Factors are by least squares over display colours:
    three numbers that hold for the other half too, where an affine map of colours would follow what is wrong with the left
    one. It depends on the pair alone: methods that fit exposures and others are scored alike. The result is clamped to [0, 1]
    and not rounded again.

    Raises:
        Inapplicable: the truth has alpha or depth, as renderings have, which are all under one exposure.
        Skip: a half has too few pixels that count.
    """
    if pair.true_alpha is not None or pair.true_depth is not None:
        raise Inapplicable("rendered views are all under one exposure")
    middle = pair.truth.shape[1] // 2
    left, right = (_columns(pair, part) for part in (slice(0, middle), slice(middle, None)))
    image, truth = (_counted(values, left) for values in (left.image, left.truth))
    if min(len(image), len(_counted(right.image, right))) < FEWEST:
        raise Skip(f"a half of the view has fewer than {FEWEST} pixels that count")
    power = np.square(image).sum(axis=0)
    gain = np.where(power > 0, (image * truth).sum(axis=0) / np.maximum(power, 1e-12), 1.0)
    return psnr(replace(right, image=(right.image.double() * torch.from_numpy(gain)).clamp(0, 1)))


def _columns(pair: Pair, part: slice) -> Pair:
    """Colours and mask of some columns of the pictures."""
    mask = None if pair.mask is None else pair.mask[:, part]
    return Pair(pair.image[:, part].cpu(), pair.truth[:, part].cpu(), pair.pred_alpha[:, part], mask=mask)


def _counted(values: torch.Tensor, pair: Pair) -> np.ndarray:
    """Colours of the pixels that count, (n, 3), in double precision."""
    return (values.reshape(-1, 3) if pair.mask is None else values[pair.mask]).double().numpy()


PSNR_EXPOSED = Metric(
    "psnr_exposed",
    "dB",
    True,
    psnr_exposed,
    "PSNR of each view's right half under the gain per channel that fits its left half: what exposure costs is left out",
)
