"""Geometry scores of a fitted surface against the scene's true one."""

from __future__ import annotations

from dataclasses import replace

from invgraphics.core import Mesh, Model, Quantity, Scene
from invgraphics.core.scan import Scan
from invgraphics.errors import InputError
from invgraphics.fields.isosurface import SPECK, extract_mesh
from invgraphics.metrics.dtu import DENSITY, dtu_score
from invgraphics.metrics.surface_metrics import SURFACE_METRICS
from invgraphics.metrics.surfaces import F_SCORE_SHARE, POINTS, compare_surfaces
from invgraphics.runs.scores import Score

RESOLUTION = 192
"""Voxels along the longest edge from which the surface of a signed distance is extracted for its scores."""

Scored = tuple[dict[str, Score], dict[str, str]]


def surface_scores(model: Model, scene: Scene) -> Scored:
    """Score a model's surface: the ``quality`` and ``skipped`` parts of a ``scores.json``.

    A signed distance is cut at zero, and its smallest pieces are left out (`SPECK`); a mesh is taken as it is. Other fields
    have no surface of their own; `export --to mesh` scores what it extracts of them.

    Args:
        model: fitted.
        scene: in the model's frame.
    """
    if reason := _unknown(scene):
        return {}, dict.fromkeys(SURFACE_METRICS, reason)
    field, how = model.field, ""
    if Quantity.MESH in field.provides:
        mesh: Mesh = field.primitives(Quantity.MESH, model.context())
    elif Quantity.SDF in field.provides:
        try:
            extracted = extract_mesh(field, model.bounds, RESOLUTION)
        except InputError as error:
            return {}, dict.fromkeys(SURFACE_METRICS, error.sentence)
        mesh, pieces = extracted.mesh, f"{extracted.dropped} pieces of less than {SPECK:.1%} of the triangles left out"
        how = f"; signed distance at {RESOLUTION} voxels along the longest edge, {pieces}"
    else:
        reason = "the field has no surface of its own; `invgraphics export RUN --to mesh` scores the one that it extracts"
        return {}, dict.fromkeys(SURFACE_METRICS, reason)
    quality, skipped = mesh_scores(mesh.to("cpu"), scene)
    return {name: replace(score, joined=score.joined + how) for name, score in quality.items()}, skipped


def mesh_scores(mesh: Mesh, scene: Scene) -> Scored:
    """Score a mesh against the scene's true one, on surface that training cameras see; lengths in world units.

    Where the truth is a scan, it is scored by DTU's rule instead.

    Args:
        mesh: in the scene's local frame.
        scene: whose training cameras count.
    """
    if reason := _unknown(scene):
        return {}, dict.fromkeys(SURFACE_METRICS, reason)
    if scene.scan is not None:
        return _dtu_scores(mesh, scene, scene.scan)
    assert scene.mesh is not None
    box = scene.data_bounds or scene.bounds  # a run's own box would give each run another threshold
    threshold = F_SCORE_SHARE * float((box.hi - box.lo).max())
    try:
        found = compare_surfaces(mesh, scene.mesh, threshold, [view.camera for view in scene.train], POINTS)
    except ValueError as error:
        return {}, dict.fromkeys(SURFACE_METRICS, str(error))
    values = {
        "chamfer": found.chamfer * scene.scale,
        "surface_accuracy": found.accuracy * scene.scale,
        "surface_completeness": found.completeness * scene.scale,
        "f_score": found.f_score,
        "normal_consistency": found.normal_consistency,
    }
    joined = {
        "f_score": f"F-score at {threshold * scene.scale:.4g} world units: precision {found.precision:.3f}, recall "
        f"{found.recall:.3f}"
    }
    metrics = SURFACE_METRICS
    return {
        name: Score(
            mean=value,
            unit=metrics[name].unit,
            higher_is_better=metrics[name].higher_is_better,
            joined=joined.get(name, "of points on both surfaces"),
        )
        for name, value in values.items()
    }, {}


def _dtu_scores(mesh: Mesh, scene: Scene, scan: Scan) -> Scored:
    """Scores by DTU's rule, in the data set's millimetres; it has neither an F-score nor normals."""
    rule = f"DTU's rule, {scene.notes.get('reference_scan', '')}".rstrip(", ")
    try:
        found = dtu_score(mesh.transformed(scene.world_from_local), scan)
    except ValueError as error:
        return {}, dict.fromkeys(SURFACE_METRICS, f"{rule}: {error}")
    values = {"chamfer": found.overall, "surface_accuracy": found.accuracy, "surface_completeness": found.completeness}
    if found.density < DENSITY:
        rule += f"; {found.density:.3g} instead of {DENSITY:g} random points per mm² of a vast surface, before thinning"
    quality = {name: Score(mean=value, unit="mm", higher_is_better=False, joined=rule) for name, value in values.items()}
    return quality, dict.fromkeys(SURFACE_METRICS.keys() - values.keys(), "DTU's rule has no such score")


def _unknown(scene: Scene) -> str:
    """Why the scene's true surface is unknown; empty where it is known."""
    if scene.mesh is not None or scene.scan is not None:
        return ""
    return scene.notes.get("reference_scan", "the scene has no true surface")
