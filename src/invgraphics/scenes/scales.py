"""The same scene in smaller pictures: rendered scenes as a rendering of that size, photographs as area averages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from invgraphics.core import Scene, View
from invgraphics.core.colour import quantise
from invgraphics.errors import InputError
from invgraphics.scenes.open import open_scene, source_of
from invgraphics.scenes.pictures.masks import WHOLE
from invgraphics.scenes.pictures.resize import area_resize, wanted_size

SMALLEST = 12
"""Shortest side in pixels that pictures can be scaled down to: SSIM's window has 11."""


def check_scales(scales: tuple[int, ...], name: str) -> None:
    """Check divisors of a picture's size: whole, at least 1, each once.

    Raises:
        ValueError: they are not.
    """
    if not scales or min(scales) < 1 or len(set(scales)) < len(scales):
        raise ValueError(f"'{name}' must hold divisors of the pictures' size, each at least 1 and once, not {list(scales)}.")


def scene_at(scene: Scene, divisor: int) -> Scene:
    """The scene with all views 1/``divisor`` as large, in the same order.

    A scene that was opened is opened again at that size, unless its pictures have several: a size to open is one for all. A
    rendered one is then a rendering at that size, or the mean of a larger one's linear light, which is the same (see
    `invgraphics.scenes.mitsuba.average`), with depth and normals of that size; photographs are averaged over each new pixel's
    area.

    Raises:
        InputError: pictures would be smaller than `SMALLEST` pixels.
    """
    if divisor == 1:
        return scene
    sides = [side for view in (*scene.train, *scene.test) for side in (view.camera.width, view.camera.height)]
    if min(sides) // divisor < SMALLEST:
        raise InputError(
            f"Pictures of '{scene.name}' at 1/{divisor} would have a side of {min(sides) // divisor} pixels.",
            f"The least is {SMALLEST}: leave out that scale, or give a larger --size.",
        )
    source = source_of(scene)
    longest = {max(view.camera.width, view.camera.height) for view in (*scene.train, *scene.val, *scene.test)}
    if source is not None and len(longest) == 1:
        smaller = open_scene(source.spec, replace(source.options, size=longest.pop() // divisor))
        return replace(smaller, bounds=scene.bounds, world_from_local=scene.world_from_local)
    return scene.with_views(
        **{name: tuple(_smaller(view, divisor) for view in getattr(scene, name)) for name in ("train", "val", "test")}
    )


def _area_average(values: Float[Tensor, "h w c"], width: int, height: int) -> Float[Tensor, "height width c"]:
    """Exact area average; where new pixels are blocks of old ones, in one pass over them.

    `area_resize` itself stays as it is: data sets are loaded by it, and the hashes of their pixels are published.
    """
    if values.shape[0] % height or values.shape[1] % width:
        return torch.from_numpy(area_resize(values.numpy().astype(np.float64), width, height)).float()
    block = values.shape[0] // height, values.shape[1] // width
    return avg_pool2d(values.permute(2, 0, 1)[None], block)[0].permute(1, 2, 0)


def _smaller(view: View, divisor: int) -> View:
    width, height = view.camera.width, view.camera.height
    return resized_view(view, *wanted_size(width, height, max(width, height) // divisor))


def like(colour: Float[Tensor, "h w 3"], view: View) -> Tensor:
    """Convert colours to the number format of the view's photograph."""
    return quantise(colour) if view.image.dtype == torch.uint8 else colour.clamp_min(0)


def resized_view(view: View, width: int, height: int) -> View:
    """Downscale a view by area average of premultiplied colour, without its geometry.

    A pixel is masked unless all of it was valid.
    """
    if view.alpha is None:
        coverage, straight = None, _area_average(view.colour(), width, height)
    else:
        alpha = view.opacity()[..., None]
        coverage = _area_average(alpha, width, height)
        straight = _area_average(view.colour() * alpha, width, height) / coverage.clamp_min(1e-6)
        coverage = quantise(coverage[..., 0]) if view.alpha.dtype == torch.uint8 else coverage[..., 0]
    valid = None if view.mask is None else _area_average(view.mask[..., None].float(), width, height)[..., 0]
    return replace(
        view,
        camera=view.camera.resized(width, height),
        image=like(straight, view),
        alpha=coverage,
        depth=None,
        normal=None,
        mask=None if valid is None else valid > WHOLE,
    )
