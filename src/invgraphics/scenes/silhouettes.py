"""Random points inside the silhouettes of photographs with alpha: a start that knows no more than these."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from invgraphics.core import Bounds, View

CANDIDATES = 100_000
"""Points drawn in the box, of which those inside are taken: an object that fills a twentieth of it still gets 5,000."""
LEAST_ALPHA = 0.05
"""Alpha above which a pixel belongs to a silhouette."""


def points_inside(bounds: Bounds, views: Sequence[View], count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Draw up to ``count`` points of the bounds' box that lie inside every silhouette (the visual hull, Laurentini 1994).

    Args:
        bounds: whose box is filled.
        views: photographs; those without alpha show no silhouette.
        count: of points; fewer come back where the hull is small.
        generator: of the random numbers.

    Returns:
        Points, uniform in the hull.
    """
    opaque = all(view.alpha is None for view in views)
    unit = torch.rand(count if opaque else max(CANDIDATES, count), 3, generator=generator)
    points = bounds.lo + unit * (bounds.hi - bounds.lo)
    return points[inside_silhouettes(points, views)][:count]


def inside_silhouettes(points: Float[Tensor, "n 3"], views: Sequence[View]) -> Bool[Tensor, " n"]:
    """Find the points that every photograph with alpha shows inside its silhouette, or does not show at all.

    A pixel's neighbours count as its own, because the object may reach as far between their centres. A pixel that a view's mask
    leaves out says nothing.
    """
    inside = torch.ones(len(points), dtype=torch.bool)
    for view in views:
        if view.alpha is None:
            continue
        index = inside.nonzero()[:, 0]
        seen, pixel = view.camera.pixel_of(points[index])
        pixel = pixel[seen]
        nearby = max_pool2d(view.opacity()[None, None], 3, stride=1, padding=1).reshape(-1)
        empty = nearby[pixel] <= LEAST_ALPHA
        if view.mask is not None:
            empty &= view.mask.reshape(-1)[pixel]
        inside[index[seen][empty]] = False
    return inside
