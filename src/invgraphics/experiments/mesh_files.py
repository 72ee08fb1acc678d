"""Mesh files in a scene's local frame."""

from __future__ import annotations

from pathlib import Path

import torch

from invgraphics.core import Mesh, Scene
from invgraphics.core.transforms import axes_to_opencv, opencv_to_axes
from invgraphics.formats.mesh import AXES, check_suffix, read_mesh

UP = "z-up"
"""How the world's axes point for glTF, by default: +z is up (CONVENTIONS.md)."""


def mesh_from_file(path: Path, scene: Scene) -> Mesh:
    """Read a mesh file to a scene's local frame: PLY and OBJ are in the data set's world, GLB is y-up and the world z-up.

    Raises:
        InputError: it cannot be read.
    """
    axes = AXES.get(check_suffix(path))
    similarity = torch.linalg.inv(scene.world_from_local.double())
    if axes is not None:
        similarity = similarity @ opencv_to_axes(UP) @ axes_to_opencv(axes)
    return read_mesh(path).transformed(similarity)
