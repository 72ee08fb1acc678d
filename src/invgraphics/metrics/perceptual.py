"""Perceptual metrics on display colours: FLIP, and LPIPS where its weights are installed."""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.metrics.base import Metric, Pair, Skip
from invgraphics.metrics.conventions import Lpips
from invgraphics.metrics.image import refuse_mask

ALEXNET_FILE = "alexnet-owt-7be5be79.pth"
"""Torchvision's AlexNet backbone, under the name that torch's model cache gives it."""

BACKBONES = {"alex": ("AlexNet", ALEXNET_FILE), "vgg": ("VGG-16", "vgg16-397923af.pth")}
"""LPIPS's name of a network -> its usual name, and torchvision's file of its weights."""

LPIPS_SHORTEST = 32
"""The networks' strides leave nothing of smaller images."""


_LPIPS = Lpips()


def flip_map(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """FLIP's error per pixel in [0, 1] (Andersson et al. 2020; LDR, the default 67 pixels per degree of visual angle).

    Args:
        image: the prediction, display sRGB in [0, 1].
        truth: the reference, likewise.
    """
    import flip_evaluator

    arrays = [np.ascontiguousarray(values.detach().float().cpu().numpy()) for values in (truth, image)]
    errors, _, _ = flip_evaluator.evaluate(arrays[0], arrays[1], "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0].copy())


def flip(pair: Pair) -> float:
    """Mean of `flip_map` over unmasked pixels."""
    errors = flip_map(pair.image, pair.truth)
    return pair.mean_within(errors.to(pair.truth.device))


def lpips_weights(net: str = "alex") -> Path:
    """Path of a backbone's weights in torch's model cache."""
    return Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[net][1]


def why_no_lpips(net: str = "alex") -> str:
    """Why LPIPS cannot be computed on this machine; empty if it can."""
    if importlib.util.find_spec("lpips") is None:
        return "the package lpips is not installed (pip install 'invgraphics[lpips]')"
    if not lpips_weights(net).is_file():
        name, missing = BACKBONES[net][0], lpips_weights(net)
        return f"the {name} weights {missing} are missing; invgraphics never downloads, put the file there"
    return ""


@cache
def _lpips_network(net: str = "alex") -> Any:
    try:
        return importlib.import_module("lpips").LPIPS(net=net, version="0.1", verbose=False).eval()
    except Exception as error:  # a damaged weight file raises anything from EOFError to UnpicklingError
        raise Skip(f"LPIPS cannot be loaded: {type(error).__name__}: {error}") from error


def lpips(pair: Pair, how: Lpips = _LPIPS) -> float:
    """Learned perceptual similarity v0.1 (Zhang et al. 2018) of a pair without masked pixels.

    Raises:
        Skip: the network is not on this machine, the images are too small, or some pixels are masked.
    """
    reason = why_no_lpips(how.net)
    if reason:
        raise Skip(reason)
    refuse_mask(pair)
    height, width = pair.truth.shape[:2]
    if min(height, width) < LPIPS_SHORTEST:
        raise Skip(f"needs {LPIPS_SHORTEST} pixels along the shorter side, the images are {width}x{height}")
    both = (values.float().cpu().permute(2, 0, 1)[None] for values in (pair.image, pair.truth))
    with torch.no_grad():
        return float(_lpips_network(how.net)(*both, normalize=how.scaled))


FLIP = Metric("flip", "", False, flip, "LDR-FLIP, mean over pixels, at 67 pixels per degree")
LPIPS = Metric("lpips", "", False, lpips, "LPIPS v0.1, AlexNet, inputs in [-1, 1]; an extra that needs weights of your own")
