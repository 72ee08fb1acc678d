"""Coloured triangle meshes as GLB, PLY and OBJ files, through trimesh."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Mesh, Scene
from invgraphics.core.colour import linear_to_srgb, srgb_to_linear
from invgraphics.core.transforms import axes_to_opencv, opencv_to_axes
from invgraphics.errors import InputError
from invgraphics.files import write_bytes
from invgraphics.tables import parse_json

SUFFIXES = (".glb", ".obj", ".ply")
AXES = {".glb": "RUB"}
"""Axes of formats that name some: glTF is right, up, back. The others hold the data set's world."""
UP = "z-up"
"""How the world's axes point for glTF, by default: +z is up (CONVENTIONS.md)."""
WORLD_KEY = "invgraphics_world"
"""In `asset.extras` of a GLB: the axes of the world from which it was turned to y-up."""
LINEAR = "_LINEAR_RGB"
"""Second name of a GLB file's linear vertex colours, for readers that round ``COLOR_0`` to bytes and so lose dark ones."""


def check_suffix(path: Path) -> str:
    """The format of a mesh file by its name's end, in lower case.

    Raises:
        InputError: it is none of `SUFFIXES`.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"'{path.name}' names no format of meshes.", f"Expected a name that ends in {', '.join(SUFFIXES)}.")
    return suffix


def write_mesh(path: Path, mesh: Mesh, rgb: Float[Tensor, "v 3"], comments: Sequence[str] = (), world: str = UP) -> None:
    """Write a mesh whole or not at all; the format is that of the file's name.

    PLY has 8-bit colours and the comments, OBJ decimal colours behind the positions (as MeshLab and Blender read them), GLB
    linear float colours, as glTF requires, and an unlit material: the colours are radiance, which no lamp lights again.

    Args:
        path: the file.
        mesh: in the file's axes; its own colours are not looked at.
        rgb: colours of the vertices, display sRGB in [0, 1].
        comments: free text, one line each.
        world: axes of the world from which a GLB was turned to y-up, which it keeps.

    Raises:
        InputError: the name has another ending, or the disk is full.
    """
    from trimesh import Trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.ply import export_ply
    from trimesh.visual import ColorVisuals

    suffix = check_suffix(path)
    normals = None if mesh.normals is None else mesh.normals.numpy()
    solid = Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), vertex_normals=normals, process=False)
    if suffix == ".glb":
        solid.vertex_attributes[LINEAR] = srgb_to_linear(rgb).numpy().astype(np.float32)
        finish = partial(_finish, comments=comments, world=world)
        data = export_glb(solid, include_normals=normals is not None, tree_postprocessor=finish)
    else:
        bytes_ = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        solid.visual = ColorVisuals(solid, vertex_colors=bytes_)
        if suffix == ".ply":
            data = export_ply(solid, vertex_normal=normals is not None)
            lines = "".join(f"comment {line}\n" for line in comments).encode("ascii", errors="replace")
            data = data.replace(b"\nelement", b"\n" + lines + b"element", 1)
        else:
            text = export_obj(solid, include_normals=normals is not None, header="\n# ".join(comments))
            data = str(text).encode()
    write_bytes(path, data)


def _finish(tree: dict[str, Any], comments: Sequence[str], world: str) -> None:
    """Name the colours, make the material unlit and two-sided, and say where the mesh comes from and how its world points."""
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["attributes"]["COLOR_0"] = primitive["attributes"][LINEAR]
    primitive["material"] = 0
    plain = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"pbrMetallicRoughness": plain, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}]
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "KHR_materials_unlit"})
    tree["asset"]["copyright"] = "; ".join(comments)
    tree["asset"]["extras"] = {WORLD_KEY: world}


def read_mesh(path: Path) -> Mesh:
    """Read the triangles of a mesh file, in the file's axes, with vertex colours in display sRGB where it has some.

    Textures are not read, nor any file that the mesh refers to.

    Raises:
        InputError: it is no such file, or has no triangles, or positions that are not finite.
    """
    import trimesh

    suffix = check_suffix(path)
    try:
        options: dict[str, Any] = {"skip_materials": True, "maintain_order": True} if suffix == ".obj" else {}
        loaded: Any = trimesh.load_mesh(io.BytesIO(path.read_bytes()), file_type=suffix[1:], process=False, **options)
        vertices, faces = np.asarray(loaded.vertices, np.float32), np.asarray(loaded.faces, np.int64)
        rgb = _colours(loaded, suffix)
    except OSError:
        raise
    except Exception as error:  # what a damaged file makes of a reader
        raise InputError(f"'{path}' cannot be read as a mesh: {type(error).__name__}: {error}.") from error
    if not len(faces) or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"'{path}' has no triangles with finite corners.")
    if rgb is None:
        return Mesh(torch.from_numpy(vertices.copy()), torch.from_numpy(faces.copy()))
    return Mesh.coloured(torch.from_numpy(vertices.copy()), torch.from_numpy(faces.copy()), rgb)


def _colours(loaded: Any, suffix: str) -> Float[Tensor, "v 3"] | None:
    """Display sRGB of the vertices; ``None`` where there is none."""
    exact = loaded.vertex_attributes.get(LINEAR)
    if exact is not None:
        return linear_to_srgb(torch.from_numpy(np.asarray(exact, np.float32)[:, :3].copy()))
    if loaded.visual.kind != "vertex":
        return None
    rgb = torch.from_numpy(loaded.visual.vertex_colors[:, :3].astype(np.float32) / 255)
    return linear_to_srgb(rgb) if suffix == ".glb" else rgb


def mesh_from_file(path: Path, scene: Scene) -> Mesh:
    """Read a mesh file to a scene's local frame.

    PLY and OBJ are in the data set's world. GLB is y-up; how the world points stands in files that were exported here, and is
    taken to be z-up in others.

    Raises:
        InputError: it cannot be read.
    """
    axes = AXES.get(check_suffix(path))
    similarity, mesh = torch.linalg.inv(scene.world_from_local.double()), read_mesh(path)
    if axes is not None:
        similarity = similarity @ opencv_to_axes(_world_of(path)) @ axes_to_opencv(axes)
    return mesh.transformed(similarity)


def _world_of(path: Path) -> str:
    """How the axes of the world point from which a GLB was written; `UP` where it does not say."""
    data = path.read_bytes()
    try:
        length = int.from_bytes(data[12:16], "little")
        world = parse_json(data[20 : 20 + length].decode(), str(path))["asset"]["extras"][WORLD_KEY]
        axes_to_opencv(str(world))
    except (ValueError, KeyError, TypeError, InputError):
        return UP
    return str(world)
