"""Reading of single pictures: a run's saved predictions and ground truth, and the files of other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from invgraphics.arrays import read_numbers
from invgraphics.core import Camera, Rendering, Scene, View
from invgraphics.core.colour import srgb_to_linear
from invgraphics.errors import InputError
from invgraphics.scenes.pictures.images import read_pixels


def read_truth(path: Path, scene: Scene) -> View:
    """Read a true view from its picture and the arrays that `save_truth` wrote beside it; depth in world units."""
    pixels = read_pixels(path)
    arrays = read_numbers(path.with_suffix(".npz")) if path.with_suffix(".npz").is_file() else {}
    image, alpha = torch.from_numpy(pixels[..., :3].copy()), None
    if "rgb" in arrays:
        image = torch.from_numpy(arrays["rgb"])
        image = image if image.dtype == torch.uint8 else image.float()
        if "alpha" in arrays:
            coverage = torch.from_numpy(arrays["alpha"]).float()
            # Bytes divided by 255 survive float16, and come back as bytes.
            alpha = (coverage * 255).round().to(torch.uint8) if image.dtype == torch.uint8 else coverage
    elif scene.colour == "linear":
        image = srgb_to_linear(image.float() / 255)
    if has_transparency(pixels):
        alpha = torch.from_numpy(pixels[..., 3].copy())
    depth, normal = (torch.from_numpy(arrays[key]).float() if key in arrays else None for key in ("depth", "normal"))
    mask = torch.from_numpy(arrays["mask"]) if "mask" in arrays else None
    return View(_any_camera(image), image, path.stem, alpha, depth, normal, mask)


def is_baked(truth: Path) -> bool:
    """Whether a saved truth's transparency is lost: it is stored only as composited over the scene's background."""
    path = truth.with_suffix(".npz")
    arrays = read_numbers(path) if path.is_file() else {}
    return "alpha" in arrays and "rgb" not in arrays and bool((arrays["alpha"] < 1).any())


def has_transparency(pixels: UInt8[np.ndarray, "h w c"]) -> bool:
    """Whether a picture has transparent pixels."""
    return pixels.shape[2] == 4 and bool(pixels[..., 3].min() < 255)


def _any_camera(image: torch.Tensor) -> Camera:
    height, width = image.shape[:2]
    return Camera(torch.eye(4), torch.ones(2), torch.tensor([width / 2, height / 2]), width, height)


def read_picture(path: Path) -> Rendering:
    """Read a prediction from any tool's picture file, in display sRGB; straight alpha if it has an alpha channel."""
    values = torch.from_numpy(read_pixels(path)).float() / 255
    alpha = values[..., 3] if values.shape[2] == 4 else torch.ones(values.shape[:2])
    return Rendering(values[..., :3] * alpha[..., None], alpha, torch.full_like(alpha, torch.inf))


def read_saved(path: Path, scene: Scene, exact: bool) -> Rendering:
    """Read a prediction that `evaluate` saved, in the scene's colour space and world units.

    Args:
        path: the ``.npz``, half-precision colours.
        scene: background and colour space.
        exact: take the colours from the 8-bit picture beside it, so that over the scene's background they are the very bytes
            that were scored, free of half precision.
    """
    arrays = read_numbers(path)
    if not {"rgb", "alpha", "depth"} <= set(arrays):
        raise InputError(f"'{path}' lacks colour, alpha or depth.", "Score the run again: invgraphics evaluate.")
    rgb, alpha, depth = (torch.from_numpy(arrays[key]).float() for key in ("rgb", "alpha", "depth"))
    if alpha.ndim != 2 or rgb.shape != (*alpha.shape, 3) or depth.shape != alpha.shape:
        raise InputError(f"Colour, alpha and depth of '{path}' differ in size.", "Score the run again: invgraphics evaluate.")
    if exact and bool(rgb.isfinite().all()):
        shown = torch.from_numpy(read_pixels(path.with_suffix(".png"))[..., :3].copy()).float() / 255
        shown = srgb_to_linear(shown) if scene.colour == "linear" else shown
        rgb = shown - (1 - alpha[..., None]) * scene.background
    normal = torch.from_numpy(arrays["normal"]).float() if "normal" in arrays else None
    return Rendering(rgb, alpha, depth, normal)
