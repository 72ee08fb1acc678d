"""Gaussians under similarities: rotation, one scale and translation of means, axes, sizes and colours."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import harmonics
from invgraphics.core.field import Gaussians
from invgraphics.core.transforms import transform_points
from invgraphics.errors import InputError


def split_similarity(similarity: Float[Tensor, "4 4"]) -> tuple[Float[Tensor, ""], Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """Scale, rotation and translation of a similarity.

    Raises:
        InputError: the matrix shears, mirrors or is singular.
    """
    linear = similarity[:3, :3]
    determinant = torch.linalg.det(linear)
    if not determinant > 0:
        raise InputError("A similarity must have a positive determinant: it cannot mirror or flatten the scene.")
    scale = determinant ** (1 / 3)
    rotation = linear / scale
    error = (rotation @ rotation.T - torch.eye(3, dtype=linear.dtype, device=linear.device)).abs().max()
    if error > 1e-3:
        raise InputError("A similarity must be a rotation times one scale, but this one shears or stretches.")
    return scale, rotation, similarity[:3, 3]


def transform_gaussians(gaussians: Gaussians, similarity: Float[Tensor, "4 4"]) -> Gaussians:
    """Apply a similarity to Gaussians: means, axes, scales, and spherical harmonics by rotation.

    Raises:
        InputError: the matrix is no similarity.
    """
    scale, rotation, _ = split_similarity(similarity)
    return Gaussians(
        means=transform_points(similarity, gaussians.means),
        quaternions=_multiply(_quaternion(rotation), gaussians.quaternions),
        scales=gaussians.scales * scale,
        opacities=gaussians.opacities,
        sh=harmonics.rotate(gaussians.sh, rotation),
    )


def _quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """The unit quaternion (w, x, y, z) of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.detach().double().cpu().numpy()).as_quat()
    return rotation.new_tensor([w, x, y, z])


def _multiply(left: Float[Tensor, " 4"], right: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Hamilton product of quaternions (w, x, y, z): the rotation ``right``, then ``left``."""
    w, x, y, z = left.unbind()
    matrix = torch.stack(
        [
            torch.stack([w, -x, -y, -z]),
            torch.stack([x, w, -z, y]),
            torch.stack([y, z, w, -x]),
            torch.stack([z, -y, x, w]),
        ]
    )
    return right @ matrix.T
