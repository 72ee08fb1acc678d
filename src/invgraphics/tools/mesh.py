"""Export of a run's model as a triangle mesh, with its errors where the true surface is known."""

from __future__ import annotations

from dataclasses import replace

from invgraphics.core import Mesh, Quantity, Rendering
from invgraphics.core.colour import linear_to_srgb
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.experiments.surface_scores import mesh_scores
from invgraphics.fields.depth_fusion import TRUNCATION, fuse_depth
from invgraphics.fields.isosurface import Extracted, default_level, extract_mesh, with_attributes
from invgraphics.formats.mesh import AXES, UP, check_suffix, write_mesh
from invgraphics.tools.export import RESOLUTION, Exported, ExportRequest
from invgraphics.tools.file_frames import file_from_local

MOST_PICTURES = 64
"""Training views whose depth is fused, evenly spaced; more cost time and add little."""


def export_mesh(fitted: Fitted, request: ExportRequest) -> Exported:
    """Write the model's surface as a triangle mesh with vertex colours: GLB, PLY or OBJ, by the file's name.

    A mesh is written as it is; a density or a distance is cut at a level by marching cubes, unless it is seen as Gaussians; of
    anything else, depth pictures are fused. PLY and OBJ hold the data set's world, GLB is y-up.

    Raises:
        InputError: the model shows no surface, or the file cannot be written.
    """
    suffix, scene, provides = check_suffix(request.out), fitted.scene, fitted.model.field.provides
    if Quantity.MESH in provides:
        extracted, how = _own_mesh(fitted, request)
    elif (Quantity.SDF | Quantity.DENSITY) & provides and Quantity.GAUSSIANS not in fitted.model.renderer.requires:
        extracted, how = _marching_cubes(fitted, request)
    else:
        extracted, how = _fuse_depth(fitted, request)
    mesh = extracted.mesh.to("cpu")
    if not len(mesh.faces) or mesh.rgb is None:
        raise InputError(f"The model of '{request.run}' has no coloured surface in the scene's bounds.", "Fit it for longer.")
    axes = AXES.get(suffix)
    world = (request.world or UP) if axes else UP
    note = f"invgraphics: {fitted.method.name} on {scene.name}, in {_frame(axes)}; {how}"
    rgb = linear_to_srgb(mesh.rgb) if scene.colour == "linear" else mesh.rgb
    write_mesh(request.out, mesh.transformed(file_from_local(scene, axes, world)), rgb.clamp(0, 1), (note,), world)
    open_edges = mesh.open_edges()
    facts = {
        "vertices": f"{len(mesh.vertices):,}",
        "triangles": f"{len(mesh.faces):,}",
        "bytes": str(request.out.stat().st_size),
        "surface": how,
        "open edges": f"{open_edges:,}" if open_edges else "none: the surface is closed",
        "small pieces left out": str(extracted.dropped),
        "colours": "the mean over all directions" if mesh.sh is not None and mesh.sh.shape[1] > 1 else "as seen from outside",
        "axes": _frame(axes) + (f" (the world is {world})" if axes else ""),
    }
    return Exported(request.out, facts | _truth_distances(mesh, fitted))


def _frame(axes: str | None) -> str:
    return "the data set's world" if axes is None else "glTF's axes, +y up"


def _own_mesh(fitted: Fitted, request: ExportRequest) -> tuple[Extracted, str]:
    """The field's mesh as it is."""
    given = {"--level": request.level, "--resolution": request.resolution}
    if idle := [option for option, value in given.items() if value is not None]:
        raise InputError(f"The model of '{request.run}' is a mesh already.", f"Leave {' and '.join(idle)} out.")
    mesh: Mesh = fitted.model.field.primitives(Quantity.MESH, fitted.model.context())
    if mesh.sh is None:
        mesh = with_attributes(mesh, fitted.model.field)
    return Extracted(mesh), "the mesh of the field"


def _marching_cubes(fitted: Fitted, request: ExportRequest) -> tuple[Extracted, str]:
    """Extract the surface by marching cubes; also names the method in words."""
    bounds, resolution = fitted.model.bounds, request.resolution or RESOLUTION
    remedy = "Choose another --level, or fit for longer."
    extracted = extract_mesh(fitted.model.field, bounds, resolution, request.level, remedy)
    if Quantity.SDF in fitted.model.field.provides:
        return extracted, f"signed distance {request.level or 0:g}, {resolution} voxels along the longest edge"
    level = default_level(bounds) if request.level is None else request.level
    return extracted, f"density {level:.3g} per local unit, {resolution} voxels along the longest edge"


def _fuse_depth(fitted: Fitted, request: ExportRequest) -> tuple[Extracted, str]:
    """Extract the surface by fusion of the training views' depth maps (median depth, where the renderer has it)."""
    if request.level is not None:
        remedy = "Leave --level out: its depth pictures are fused."
        raise InputError(f"The model of '{request.run}' ({fitted.method.name}) has no density with a level.", remedy)
    model = replace(fitted.model, renderer=fitted.model.renderer.for_depth_fusion())
    scene, resolution = fitted.scene, request.resolution or RESOLUTION
    count = min(MOST_PICTURES, len(scene.train))
    views = [scene.train[round(index * (len(scene.train) - 1) / max(1, count - 1))] for index in range(count)]
    cameras = [view.camera for view in views]
    with Reporter("fusing") as reporter:

        def render(index: int) -> Rendering:
            reporter.show((index + 1) / count, f"view {index + 1} of {count}")
            return model.render(cameras[index])

        extracted = fuse_depth(cameras, render, scene.bounds, resolution)
    kind = model.renderer.depth_kind
    how = f"{kind} depth of {count} training views, {resolution} voxels along the longest edge, band of {TRUNCATION:g}"
    return extracted, how


def _truth_distances(mesh: Mesh, fitted: Fitted) -> dict[str, str]:
    """The geometry scores of the mesh in words; empty where the true surface is unknown."""
    quality, _ = mesh_scores(mesh, fitted.scene)
    return {name.replace("_", " "): f"{score.mean:.4g} {score.unit}".strip() for name, score in quality.items()}
