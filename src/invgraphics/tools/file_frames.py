"""Transforms between a Gaussian file's axes, the data set's world and the scene's local frame."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.core.transforms import axes_to_opencv, opencv_to_axes
from invgraphics.errors import InputError
from invgraphics.tables import read_json

WORLD = "opencv"
"""Default axes of the world where none are given: those that file converters assume for a PLY."""

Pose = Float[Tensor, "4 4"]


def world_from_file(axes: str | None, world: str = WORLD) -> Pose:
    """The rotation from a file's axes to the data set's world, float64.

    Args:
        axes: of the file; ``None``: it was written in the world's own axes.
        world: axes of the world, as `axes_to_opencv` reads them.

    Raises:
        InputError: these are no axes of a right-handed frame.
    """
    to_world = opencv_to_axes(world)
    return to_world @ (axes_to_opencv(world) if axes is None else axes_to_opencv(axes))


def local_from_file(scene: Scene, axes: str | None, world: str = WORLD) -> Pose:
    """The similarity from a file's frame to the scene's local frame, float64."""
    return torch.linalg.inv(scene.world_from_local.double()) @ world_from_file(axes, world)


def file_from_local(scene: Scene, axes: str | None, world: str = WORLD) -> Pose:
    """Inverse of `local_from_file`."""
    return world_from_file(axes, world).T @ scene.world_from_local.double()


def file_from_world(path: Path, scene_spec: str) -> Pose:
    """Similarity from the data set's world to a file's frame, float64, as nerfstudio's ``dataparser_transforms.json`` has it.

    That begins with the ``applied_transform`` and ``applied_scale`` that a data set's ``transforms.json`` may name, which its
    poses, our world, have had already.

    Args:
        path: JSON with ``transform``, 3 x 4 or 4 x 4, and ``scale``: x_file = scale * transform * x.
        scene_spec: name or path of the scene.

    Raises:
        InputError: the file is missing, no JSON, or holds no similarity.
    """
    table = read_json(path)
    if not isinstance(table, dict):
        raise InputError(f"'{path}' holds no table.", "Expected the keys 'transform' and 'scale'.")
    found = _similarity(table.get("transform"), f"'transform' of '{path}'")
    found[:3] *= _number(table.get("scale", 1.0), f"'scale' of '{path}'")
    folder = Path(os.path.expandvars(scene_spec))
    listed = folder if folder.suffix == ".json" else folder / "transforms.json"
    applied = read_json(listed) if listed.is_file() else {}
    if isinstance(applied, dict) and "applied_transform" in applied:
        found = found @ torch.linalg.inv(_similarity(applied["applied_transform"], f"'applied_transform' of '{listed}'"))
    if isinstance(applied, dict) and "applied_scale" in applied:
        found[:3] /= _number(applied["applied_scale"], f"'applied_scale' of '{listed}'")
    return found


def _number(value: object, what: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < float("inf"):
        raise InputError(f"{what} is {value!r}, no positive number.")
    return float(value)


def _similarity(rows: object, what: str) -> Pose:
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        matrix = torch.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not bool(matrix.isfinite().all()):
        raise InputError(f"{what} is no finite matrix of 3 x 4 or 4 x 4 numbers.")
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3] = matrix[:3]
    square = whole[:3, :3] @ whole[:3, :3].T
    scale = square.diagonal().mean()
    if not float(scale) > 0 or float((square / scale - torch.eye(3)).abs().max()) > 1e-3:
        raise InputError(f"{what} is no similarity: its axes are not orthogonal, or not of one length.")
    if float(torch.linalg.det(whole[:3, :3])) < 0:
        raise InputError(f"{what} mirrors the world, which turns no Gaussian into another.")
    return whole
