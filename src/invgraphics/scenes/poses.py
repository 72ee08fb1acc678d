"""Poses of cameras as data sets hold them: checked, and made exactly rigid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.errors import InputError

RIGID = 1e-3
"""A pose that is farther from a rotation than this is an error, not rounding."""


def pose(values: object, where: str) -> Float[Tensor, "4 4"]:
    """Convert nested lists or an array of 3 or 4 rows to a rigid 4x4 pose in float64, orthonormalised.

    Raises:
        InputError: wrong shape, not finite, or not rigid; ``where`` names the file and the view.
    """
    try:
        matrix = torch.as_tensor(values, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        matrix = torch.empty(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(f"The pose of {where} is not a 4x4 matrix of numbers.")
    _check(matrix, where)
    return _orthonormal(matrix[None])[0]


def poses(matrices: Float[Tensor, "n r 4"], where: Callable[[int], str]) -> Float[Tensor, "n 4 4"]:
    """Convert matrices of 3 or 4 rows to rigid poses as `pose` does, all at once: a class of objects has thousands.

    Raises:
        InputError: one is not finite or not rigid; ``where`` names its file and view by its index.
    """
    matrices = matrices.double()
    rotation = matrices[:, :3, :3]
    error = (rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(1, 2))
    good = matrices.isfinite().all(dim=2).all(dim=1) & (error <= RIGID)
    good &= torch.linalg.det(torch.where(good[:, None, None], rotation, torch.eye(3, dtype=torch.float64))) > 0
    for index in (~good).nonzero()[:, 0].tolist():
        _check(matrices[index], where(index))
    return _orthonormal(matrices)


def _check(matrix: Float[Tensor, "r 4"], where: str) -> None:
    if not bool(matrix.isfinite().all()):
        raise InputError(f"The pose of {where} has entries that are not finite.", "Remove the view or estimate its pose again.")
    rotation = matrix[:3, :3]
    error = float((rotation.T @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
    if error > RIGID:
        raise InputError(f"The pose of {where} is not rigid: its axes are off from orthonormal by {error:.2g}.")
    if float(torch.linalg.det(rotation)) < 0:
        raise InputError(f"The pose of {where} is left-handed: its rotation has determinant -1.")


def _orthonormal(matrices: Float[Tensor, "n r 4"]) -> Float[Tensor, "n 4 4"]:
    """The nearest rotations, by a singular value decomposition."""
    u, _, vh = torch.linalg.svd(matrices[:, :3, :3])
    result = torch.eye(4, dtype=torch.float64).repeat(len(matrices), 1, 1)
    result[:, :3, :3], result[:, :3, 3] = u @ vh, matrices[:, :3, 3]
    return result
