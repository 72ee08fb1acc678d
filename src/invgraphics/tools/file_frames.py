"""Transforms between a Gaussian file's axes, the data set's world and the scene's local frame."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.core.transforms import axes_to_opencv, opencv_to_axes

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
