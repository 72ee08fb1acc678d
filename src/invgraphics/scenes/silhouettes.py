"""Silhouettes of photographs with alpha: points inside all of them, and a box around these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from invgraphics.core import Bounds, Scene, View

CANDIDATES = 100_000
"""Points drawn in the box, of which those inside are taken: an object that fills a twentieth of it still gets 5,000."""
LEAST_ALPHA = 0.05
"""Alpha above which a pixel belongs to a silhouette."""

GRID = 48
"""Cells along each edge of a box that is tightened."""
CONTRADICTIONS = 0.02
"""Share of the photographs that may show a cell outside their silhouettes before it is empty."""
SHOWN = 0.5
"""A connected component is kept if at least this share of the number of views that see the most seen cell see one of it."""
WORTHWHILE = 0.75
"""Share of its volume above which a box stays as it is."""


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

    Silhouettes are dilated by a pixel, because the object may reach as far between pixel centres. Masked-out pixels rule out
    no point.
    """
    inside = torch.ones(len(points), dtype=torch.bool)
    for view in views:
        if view.alpha is None:
            continue
        index = inside.nonzero()[:, 0]
        seen, pixel = view.camera.pixel_of(points[index])
        pixel = pixel[seen]
        nearby = max_pool2d(view.opacity()[None, None], 3, stride=1, padding=1).reshape(-1)
        empty = (nearby[pixel] <= LEAST_ALPHA) & view.valid().reshape(-1)[pixel]
        inside[index[seen][empty]] = False
    return inside


def tightened(scene: Scene) -> Scene:
    """Shrink a scene's box to the bounding box of its training views' visual hull (Laurentini 1994).

    What is outside it is empty, and samples, voxels and frequencies are not spent there: NeRF-synthetic's conventional box has
    almost three times the volume of `mic`'s. Cells of a grid over the box belong to the hull where at most `CONTRADICTIONS` of
    the views show all of them outside their silhouettes; then again, of a grid over what these leave.

    Returns:
        ``scene`` itself where its space is endless, its depth is known (the box of a rendered scene is exact), it shows a class
        of objects, a photograph is opaque, or the hull is empty or nearly as large as the box; else with other bounds, and a
        note ``region``.
    """
    bounds, views = scene.bounds, scene.train
    rendered = any(view.depth is not None for view in (*views, *scene.test))
    if bounds.space != "box" or rendered or scene.is_class or any(view.alpha is None for view in views):
        return scene
    box = _hull_box(bounds, views)
    box = None if box is None else _hull_box(box, views)
    if box is None or (share := float((box.half / bounds.half).prod())) > WORTHWHILE:
        return scene
    region = f"the box of the training views' silhouettes, {share:.0%} of the data set's"
    return replace(scene, bounds=box, notes=scene.notes | {"region": region})


def _hull_box(bounds: Bounds, views: Sequence[View]) -> Bounds | None:
    """Bounding box of the cells of a grid over a box that belong to the visual hull; ``None`` where there are none."""
    unit = (torch.arange(GRID) + 0.5) / GRID
    cells = bounds.from_unit(torch.stack(torch.meshgrid(unit, unit, unit, indexing="ij"), dim=-1).reshape(-1, 3))
    half = bounds.half / GRID
    count, most = torch.zeros(len(cells), dtype=torch.int32), int(CONTRADICTIONS * len(views))
    for view in views:
        index = (count <= most).nonzero()[:, 0]
        count[index[_outside(cells[index], float(half.norm()), view)]] += 1
    hull = cells[_of_the_object(count <= most, cells, views)]
    if len(hull) == 0:
        return None
    return replace(bounds, lo=hull.amin(dim=0) - half, hi=hull.amax(dim=0) + half)


def _outside(centres: Float[Tensor, "n 3"], radius: float, view: View) -> Bool[Tensor, " n"]:
    """Find the balls around points that a photograph shows wholly outside its silhouette.

    Silhouettes are read from a pyramid of pictures of half the size each, whose pixels hold the largest alpha of four: from the
    first whose pixels are as large as the ball, which touches one and its neighbours only. Masked-out pixels are solid.
    """
    camera = view.camera
    seen, pixel = camera.pixel_of(centres)
    row, column = pixel // camera.width, pixel % camera.width
    z = (centres - camera.position) @ camera.cam_to_world[:3, 2]
    pixels = radius * float(camera.focal.max()) / z.clamp_min(radius) + 1
    seen &= z > radius
    level = pixels.log2().ceil().long()
    solid = torch.where(view.valid(), view.opacity(), 1.0)
    outside, picture = torch.zeros(len(centres), dtype=torch.bool), solid[None, None]
    for size in range(int(level[seen].max()) + 1 if bool(seen.any()) else 0):
        here = (seen & (level == size)).nonzero()[:, 0]
        if len(here):
            nearby = max_pool2d(picture, 3, stride=1, padding=1)[0, 0]
            outside[here] = nearby[row[here] >> size, column[here] >> size] == 0
        picture = max_pool2d(picture, 2, ceil_mode=True)
    return outside


def _of_the_object(hull: Bool[Tensor, " n"], cells: Float[Tensor, "n 3"], views: Sequence[View]) -> Bool[Tensor, " n"]:
    """Drop the connected parts of a hull on a grid that few views show: before lenses all is inside their silhouettes."""
    from scipy.ndimage import label

    shown = torch.zeros(len(hull), dtype=torch.int32)
    for view in views:
        shown[hull] += view.camera.pixel_of(cells[hull])[0]
    labels, _ = cast(tuple[np.ndarray, int], label(hull.view(GRID, GRID, GRID).numpy()))
    part = torch.from_numpy(labels).reshape(-1)
    seen = (shown > 0) & (shown >= SHOWN * shown.max())
    return hull & torch.isin(part, part[seen].unique())
