"""A field moved by a similarity, without touching its parameters."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import harmonics
from invgraphics.core.field import Field, Gaussians, Quantity
from invgraphics.core.rendering import Context
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.transforms import transform_points
from invgraphics.errors import InputError

_MOVABLE = Quantity.DENSITY | Quantity.SDF | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES | Quantity.GAUSSIANS


class Transformed(Field):
    """Another field, seen after ``similarity``: what was at x is now at ``similarity x``.

    Densities are divided by the scale and distances multiplied by it, normals turn along. Features pass unchanged.

    Args:
        field: the field to move.
        similarity: rotation times a positive scale, and a translation; gradients flow to it.
    """

    similarity: Tensor

    def __init__(self, field: Field, similarity: Float[Tensor, "4 4"]) -> None:
        super().__init__()
        split_similarity(similarity)
        self.field = field
        self.provides = field.provides & _MOVABLE
        self.register_buffer("similarity", similarity)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`."""
        scale, rotation, translation = split_similarity(self.similarity)
        original = replace(
            samples,
            # Row vectors: multiplying by R from the right applies its inverse.
            position=(samples.position - translation) @ rotation / scale,
            direction=samples.direction @ rotation,
            t0=samples.t0 / scale,
            t1=samples.t1 / scale,
        )
        values = self.field.query(original, want)
        return FieldValues(
            density=None if values.density is None else values.density / scale,
            sdf=None if values.sdf is None else values.sdf * scale,
            radiance=values.radiance,
            normal=None if values.normal is None else values.normal @ rotation.T,
            features=values.features,
        )

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        """The moved Gaussians, where the field has some."""
        if want != Quantity.GAUSSIANS:
            return super().primitives(want, ctx)
        return move_gaussians(self.field.primitives(want, ctx), self.similarity)

    def primitive_count(self) -> int | None:
        """As many as the field itself has."""
        return self.field.primitive_count()


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


def move_gaussians(gaussians: Gaussians, similarity: Float[Tensor, "4 4"]) -> Gaussians:
    """Gaussians after a similarity: centres, axes, sizes and the directions of their colours."""
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
