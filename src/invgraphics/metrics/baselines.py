"""Trivial baselines: the mean training image, and the training view with the nearest camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Rendering, Scene, View
from invgraphics.errors import InputError
from invgraphics.metrics.protocols import Protocol, score, summarise
from invgraphics.runs.scores import Score


def mean_image(scene: Scene) -> Iterator[Rendering]:
    """For each test view, the mean of all training images, resized to it where sizes differ."""
    size = (0, 0)
    rendering = None
    for view in scene.test:
        if rendering is None or size != tuple(view.image.shape[:2]):
            size = (view.image.shape[0], view.image.shape[1])
            rendering = _picture(_mean_of(_train(scene), *size))
        yield rendering


def nearest_view(scene: Scene) -> Iterator[Rendering]:
    """For each test view, the picture of the training view with the nearest camera, see `camera_distance`."""
    for view in scene.test:
        nearest = min(_train(scene), key=lambda train: camera_distance(train.camera, view.camera, scene.extent))
        yield _picture(_premultiplied(nearest, *view.image.shape[:2]))


BASELINES: dict[str, Callable[[Scene], Iterator[Rendering]]] = {"mean image": mean_image, "nearest view": nearest_view}
"""The trivial predictions by name; each yields one rendering per test view."""


def camera_distance(a: Camera, b: Camera, extent: float) -> float:
    """Distance of the positions over the scene's extent, plus the angle between the viewing directions in radians."""
    forward_a, forward_b = a.cam_to_world[:3, 2].double(), b.cam_to_world[:3, 2].double()
    angle = torch.atan2(torch.linalg.cross(forward_a, forward_b).norm(), forward_a @ forward_b)
    return float((a.position - b.position).norm()) / extent + float(angle)


def baseline_scores(scene: Scene, protocol: Protocol) -> dict[str, dict[str, Score]]:
    """Score the baselines: name -> metric -> score, without depth and normals, which they lack."""
    scores = {}
    for name, predict in BASELINES.items():
        views = [score(picture, view, scene, protocol) for picture, view in zip(predict(scene), scene.test, strict=True)]
        scores[name], _ = summarise(views, protocol)
    return scores


def _train(scene: Scene) -> tuple[View, ...]:
    if not scene.train:
        raise InputError(f"Scene '{scene.name}' has no training views, so it has no baselines.")
    return scene.train


def _mean_of(views: tuple[View, ...], height: int, width: int) -> Float[Tensor, "h w 4"]:
    total, count = torch.zeros(height, width, 4), torch.zeros(height, width, 1)
    for view in views:  # one at a time: hundreds of photographs as floats would not fit in memory
        valid = _valid_share(view, height, width)
        total += valid * _premultiplied(view, height, width)
        count += valid
    return total / count.clamp_min(1e-6)


def _valid_share(view: View, height: int, width: int) -> Float[Tensor, "h w 1"]:
    """Share of each pixel, at another size, that a view's mask leaves."""
    if view.mask is None:
        return torch.ones(height, width, 1)
    valid = view.mask[None, None].float()
    if view.mask.shape != (height, width):
        valid = F.interpolate(valid, size=(height, width), mode="bilinear", antialias=True, align_corners=False)
    return valid[0, 0, ..., None]


def _premultiplied(view: View, height: int, width: int) -> Float[Tensor, "h w 4"]:
    """Premultiplied colour and alpha of a view, resampled with anti-aliasing to another size where needed."""
    alpha = view.opacity()[..., None]
    rgba = torch.cat([view.colour() * alpha, alpha], dim=-1)
    if rgba.shape[:2] == (height, width):
        return rgba
    planes = rgba.permute(2, 0, 1)[None]
    resized = F.interpolate(planes, size=(height, width), mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0)


def _picture(rgba: Float[Tensor, "h w 4"]) -> Rendering:
    """A rendering without geometry: its depth is inf everywhere."""
    return Rendering(rgba[..., :3], rgba[..., 3], torch.full_like(rgba[..., 3], torch.inf))
