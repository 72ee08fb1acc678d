"""Exposures of photographs, estimated from what several of them show of the same surface points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import View

EDGE = 400
"""Longest edge in pixels of the pictures that are compared: points are placed to a pixel of larger ones, not better."""
DARKEST, BRIGHTEST = 0.03, 0.97
"""Display values between which a pixel follows the exposure: others are noise, or cut off."""
ALL = 0.999
"""Share of a pixel that must be opaque and not masked."""
FEWEST_VIEWS = 3
"""Least track length of a point, so that its brightness is not that of a single view."""
FEWEST_PIXELS = 20
"""Fewest pixels of a photograph with an estimated exposure."""
REWEIGHTINGS = 10
SCALE = 0.1
"""Difference of logarithms from which a pixel loses its weight (Cauchy): highlights, occluders, points placed wrongly."""

Observations = Sequence[Int[Tensor, " k"]]
"""Of each view, the rows of the points that it shows."""


def exposure_spread(views: Sequence[View], points: Float[Tensor, "n 3"], observed: Observations) -> float | None:
    """Standard deviation of the logarithm of photographs' exposure, estimated; ``None`` where they share too few points.

    A pixel's logarithm, mean of the display channels, is modelled as brightness of its point plus exposure of its photograph,
    both fitted by iteratively reweighted least squares. Without exposures surfaces that shine leave a spread as well.

    Args:
        views: photographs, cameras in the frame of ``points``.
        points: surface points.
        observed: of each view, the rows of ``points`` that it shows.
    """
    from scipy.sparse import coo_matrix

    parts = [_pixels(view, points[rows], rows) for view, rows in zip(views, observed, strict=True)]
    view_of = np.concatenate([np.full(len(rows), index) for index, (rows, _) in enumerate(parts)])
    point_of = np.concatenate([rows for rows, _ in parts])
    value = np.concatenate([value for _, value in parts])
    often = np.bincount(point_of, minlength=len(points))[point_of] >= FEWEST_VIEWS
    view_of, point_of, value = view_of[often], point_of[often], value[often]
    counted = np.bincount(view_of, minlength=len(views)) >= FEWEST_PIXELS
    if counted.sum() < FEWEST_VIEWS:
        return None
    shape = (len(views), len(points))
    exposure, weight = np.zeros(len(views)), np.ones(len(value))
    for _ in range(REWEIGHTINGS):
        weights, values = (coo_matrix((each, (view_of, point_of)), shape).tocsr() for each in (weight, weight * value))
        exposure, brightness = _fitted(weights, values)
        weight = 1 / (1 + np.square((value - brightness[point_of] - exposure[view_of]) / SCALE))
    return float(exposure[counted].std())


def _fitted(weights: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Exposure of each view and brightness of each point, by weighted least squares; the brightness is eliminated.

    Args:
        weights: of each pixel, a sparse matrix of views by points.
        values: times its weight, likewise.
    """
    of_views, of_points = (np.asarray(weights.sum(axis=axis)).ravel() for axis in (1, 0))
    sum_of_views, sum_of_points = (np.asarray(values.sum(axis=axis)).ravel() for axis in (1, 0))
    inverse = np.divide(1, of_points, where=of_points > 0, out=np.zeros_like(of_points))
    shared = weights.multiply(inverse).tocsr()
    normal = np.diag(of_views) - (shared @ weights.T).toarray()
    exposure = np.linalg.lstsq(normal, sum_of_views - shared @ sum_of_points, rcond=1e-9)[0]  # least norm: one factor is free
    return exposure, inverse * (sum_of_points - weights.T @ exposure)


def _pixels(view: View, points: Float[Tensor, "k 3"], rows: Int[Tensor, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points at pixels that follow the exposure, and the logarithm of these pixels."""
    height, width = view.image.shape[:2]
    shrink = min(1.0, EDGE / max(height, width))
    size = (max(1, round(height * shrink)), max(1, round(width * shrink)))
    valid = view.opacity() * view.valid()
    channels = view.colour().permute(2, 0, 1)
    picture, whole = (torch.nn.functional.adaptive_avg_pool2d(values, size) for values in (channels, valid[None]))
    inside, pixel = view.camera.resized(size[1], size[0]).pixel_of(points.to(view.camera.cam_to_world))
    colour, opaque = picture.flatten(1)[:, pixel[inside]], whole.flatten()[pixel[inside]]
    usable = (colour.amin(dim=0) > DARKEST) & (colour.amax(dim=0) < BRIGHTEST) & (opaque > ALL)
    return rows[inside][usable].numpy(), colour[:, usable].log().mean(dim=0).double().numpy()
