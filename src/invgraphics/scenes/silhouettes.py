"""What the silhouettes of photographs with alpha tell: points inside all of them, and a box around these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from invgraphics.core import Bounds, Scene, View

CANDIDATES = 100_000
"""Points drawn in the box, of which those inside are taken: an object that fills a twentieth of it still gets 5,000."""
LEAST_ALPHA = 0.05
"""Alpha above which a pixel belongs to a silhouette."""

GRID = 64
"""Cells along each edge of a box that is tightened."""
CELLS_AROUND = 1.5
"""Cells that are left on each side: the hull ends within one of its outermost vertex, and alpha within a pixel."""
CONTRADICTIONS = 0.02
"""Share of the photographs that may show a point outside their silhouettes before it counts as empty."""
SHOWN = 0.5
"""Parts of the hull belong to the object where this share of the views that show its most shown vertex show one of theirs."""
WORTHWHILE = 0.75
"""Share of its volume above which a box stays as it is, as those of the built-in scenes do."""


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
    return _contradictions(points, views, 0) == 0


def _contradictions(points: Float[Tensor, "n 3"], views: Sequence[View], most: int) -> Int[Tensor, " n"]:
    """Count the photographs that show each point outside their silhouettes; from ``most`` + 1 on it is not counted on."""
    count = torch.zeros(len(points), dtype=torch.int32)
    for view in views:
        if view.alpha is None:
            continue
        index = (count <= most).nonzero()[:, 0]
        seen, pixel = view.camera.pixel_of(points[index])
        pixel = pixel[seen]
        nearby = max_pool2d(view.opacity()[None, None], 3, stride=1, padding=1).reshape(-1)
        empty = nearby[pixel] <= LEAST_ALPHA
        if view.mask is not None:
            empty &= view.mask.reshape(-1)[pixel]
        count[index[seen][empty]] += 1
    return count


def tightened(scene: Scene) -> Scene:
    """Shrink a scene's box to the bounding box of its training views' visual hull (Laurentini 1994).

    What is outside it is empty, and samples, voxels and frequencies are not spent there: NeRF-synthetic's conventional box has
    three times the volume of `mic`'s. The hull's vertices are those of a grid over the box that at most `CONTRADICTIONS` of
    the views show outside their silhouettes; before lenses all is inside these, but apart from the object.

    Returns:
        ``scene`` itself where its space is endless, it shows a class of objects, a photograph is opaque, or the hull is empty
        or nearly as large as the box; else with other bounds, and a note ``region``.
    """
    bounds, views = scene.bounds, scene.train
    if bounds.space != "box" or scene.is_class or any(view.alpha is None for view in views):
        return scene
    axes = [torch.linspace(0, 1, GRID + 1)] * 3
    vertices = bounds.from_unit(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3))
    most = int(CONTRADICTIONS * len(views))
    hull = vertices[_of_the_object(_contradictions(vertices, views, most) <= most, vertices, views)]
    if len(hull) == 0:
        return scene
    margin = CELLS_AROUND / GRID * (bounds.hi - bounds.lo)
    lo, hi = (hull.amin(dim=0) - margin).maximum(bounds.lo), (hull.amax(dim=0) + margin).minimum(bounds.hi)
    share = float(((hi - lo) / (bounds.hi - bounds.lo)).prod())
    if share > WORTHWHILE:
        return scene
    region = f"the box of the training views' silhouettes, {share:.0%} of the data set's"
    return replace(scene, bounds=replace(bounds, lo=lo, hi=hi), notes=scene.notes | {"region": region})


def _of_the_object(hull: Bool[Tensor, " n"], vertices: Float[Tensor, "n 3"], views: Sequence[View]) -> Bool[Tensor, " n"]:
    """Drop the connected parts of a hull, on the grid of `tightened`, that few views show in all: those before lenses."""
    from scipy.ndimage import label

    shown = torch.zeros(len(hull), dtype=torch.int32)
    for view in views:
        shown[hull] += view.camera.pixel_of(vertices[hull])[0]
    edge = GRID + 1
    part = torch.from_numpy(label(hull.view(edge, edge, edge).numpy())[0]).reshape(-1)
    seen = (shown > 0) & (shown >= SHOWN * shown.max())
    return hull & torch.isin(part, part[seen].unique())
