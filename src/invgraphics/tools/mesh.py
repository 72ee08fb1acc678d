"""Export of a run's model as a triangle mesh, with its errors where the true surface is known."""

from __future__ import annotations

from dataclasses import replace

import torch

from invgraphics.core import Quantity, Rendering, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.fields.starting import depth_points
from invgraphics.formats.mesh_ply import write_mesh
from invgraphics.metrics.surfaces import points_on, surface_distance
from invgraphics.tools.export import Exported, ExportRequest
from invgraphics.tools.surface_extraction import TRUNCATION, Surface, default_level, field_surface, fused_surface

MOST_PICTURES = 64
"""Training views whose depth is fused, evenly spaced; more cost time and add little."""
POINTS = 200_000
"""Points on either surface that are compared."""


def export_mesh(fitted: Fitted, request: ExportRequest) -> Exported:
    """Write the model's surface as a triangle mesh with vertex colours, in world coordinates.

    A field of densities or distances is cut at a level by marching cubes, unless it is seen as Gaussians; of anything else,
    depth pictures are fused.

    Raises:
        InputError: the model shows no surface, or the file cannot be written.
    """
    scene = fitted.scene
    cut = Quantity.SDF | Quantity.DENSITY
    if fitted.model.field.provides & cut and Quantity.GAUSSIANS not in fitted.model.renderer.requires:
        surface, how = _marching_cubes(fitted, request)
    else:
        surface, how = _fuse_depth(fitted, request)
    if not len(surface.faces):
        raise InputError(f"The model of '{request.run}' has no surface in the scene's bounds.", "Fit it for longer.")
    similarity = scene.world_from_local.cpu()
    world = surface.vertices @ similarity[:3, :3].T + similarity[:3, 3]
    note = f"invgraphics: {fitted.method.name} on {scene.name}, in the data set's world; {how}"
    write_mesh(request.out, world.numpy(), surface.faces.numpy(), display(surface.rgb, scene).numpy(), (note,))
    facts = {
        "vertices": f"{len(surface.vertices):,}",
        "triangles": f"{len(surface.faces):,}",
        "bytes": str(request.out.stat().st_size),
        "surface": how,
        "open edges": f"{surface.open_edges:,}" if surface.open_edges else "none: the surface is closed",
        "small pieces left out": str(surface.dropped),
        "axes": "the data set's world",
    }
    return Exported(request.out, facts | _truth_distances(surface, scene))


def _marching_cubes(fitted: Fitted, request: ExportRequest) -> tuple[Surface, str]:
    """Extract the surface by marching cubes; also names the method in words."""
    bounds = fitted.model.bounds
    surface = field_surface(fitted.model.field, bounds, request.resolution, request.level)
    if Quantity.SDF in fitted.model.field.provides:
        return surface, f"signed distance {request.level or 0:g}, {request.resolution} voxels along the longest edge"
    level = default_level(bounds) if request.level is None else request.level
    return surface, f"density {level:.3g} per local unit, {request.resolution} voxels along the longest edge"


def _fuse_depth(fitted: Fitted, request: ExportRequest) -> tuple[Surface, str]:
    """Extract the surface by fusion of the training views' depth maps (median depth, where the renderer has it)."""
    if request.level is not None:
        remedy = "Leave --level out: its depth pictures are fused."
        raise InputError(f"The model of '{request.run}' ({fitted.method.name}) has no density with a level.", remedy)
    model = replace(fitted.model, renderer=fitted.model.renderer.for_depth_fusion())
    scene = fitted.scene
    count = min(MOST_PICTURES, len(scene.train))
    views = [scene.train[round(index * (len(scene.train) - 1) / max(1, count - 1))] for index in range(count)]
    cameras = [view.camera for view in views]
    with Reporter("fusing") as reporter:

        def render(index: int) -> Rendering:
            reporter.show((index + 1) / count, f"view {index + 1} of {count}")
            return model.render(cameras[index])

        surface = fused_surface(cameras, render, scene.bounds, request.resolution)
    kind = model.renderer.depth_kind
    how = f"{kind} depth of {count} training views, {request.resolution} voxels along the longest edge, band of {TRUNCATION:g}"
    return surface, how


def _truth_distances(surface: Surface, scene: Scene) -> dict[str, str]:
    """Distances between the mesh and the true surface, in world units; empty where that is unknown.

    Completeness is measured on points of the training views' true depth only: the inside of objects is unobservable.
    """
    if scene.mesh is None or not any(view.depth is not None for view in scene.train):
        return {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        seen = depth_points(scene, POINTS).position
    generator = torch.Generator().manual_seed(0)
    ours = points_on(surface.vertices, surface.faces, POINTS, generator)
    true = torch.cat([points_on(scene.mesh.vertices, scene.mesh.faces, POINTS, generator), seen])
    found = surface_distance(ours, true, seen)
    return {
        "mean distance to the truth": f"{found.accuracy * scene.scale:.4g} world units",
        "mean distance from the truth seen": f"{found.completeness * scene.scale:.4g} world units",
    }
