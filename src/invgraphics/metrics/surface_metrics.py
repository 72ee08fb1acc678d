"""Names, units and definitions of the geometry scores of distances and meshes; computed in `invgraphics.metrics.surfaces`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceMetric:
    """A geometry score of a mesh: name, unit and direction; `summary` defines it in a line."""

    name: str
    unit: str
    higher_is_better: bool
    summary: str


_SPECKS = "of signed distances at 192 voxels along the box, without pieces below 0.1% of the triangles"
_VISIBLE = "on surface that a training camera sees"
SURFACE_METRICS = {
    metric.name: metric
    for metric in (
        SurfaceMetric("chamfer", "world units", False, f"mean of surface_accuracy and surface_completeness; {_SPECKS}"),
        SurfaceMetric(
            "surface_accuracy", "world units", False, f"mean distance to the true surface of predicted points {_VISIBLE}"
        ),
        SurfaceMetric(
            "surface_completeness", "world units", False, f"mean distance to the predicted surface of true points {_VISIBLE}"
        ),
        SurfaceMetric(
            "f_score",
            "",
            True,
            "harmonic mean of the shares of these points within 1% of the data set's box",
        ),
        SurfaceMetric(
            "normal_consistency", "", True, "mean |cosine| between the normals of these points and of the nearest ones"
        ),
    )
}
"""Geometry scores by name."""
