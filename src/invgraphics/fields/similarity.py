"""Gaussians under similarities (of means, axes, sizes and colours), and with reordered axes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Context, Field, FieldValues, Quantity, Samples, harmonics
from invgraphics.core.field import Gaussians
from invgraphics.core.transforms import transform_points
from invgraphics.errors import InputError

_TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
"""Quaternions (w, x, y, z) of the cyclic permutations of the axes that make the first, second or third axis the third."""


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


def with_shortest_third(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians, with axes permuted cyclically so that the third is the shortest; ties keep the third."""
    scales = gaussians.scales
    shortest = torch.where(scales[:, 2] <= scales.amin(dim=1), 2, scales.argmin(dim=1))
    order = (shortest[:, None] + torch.tensor([1, 2, 3], device=scales.device)) % 3
    a, b = gaussians.quaternions, gaussians.quaternions.new_tensor(_TURNS)[shortest]
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(dim=1, keepdim=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return replace(gaussians, scales=scales.gather(1, order), quaternions=torch.cat([w, xyz], dim=1))


class ShortestThird(Field):
    """A field of Gaussians as `with_shortest_third` gives them, for discs of Gaussians that were not fitted as such.

    Args:
        source: provides Gaussians.
    """

    def __init__(self, source: Field) -> None:
        super().__init__()
        self.source, self.provides = source, source.provides

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """The source's values."""
        return self.source.query(samples, want)

    @override
    def primitives(self, want: Quantity, ctx: Context) -> Any:
        """The source's Gaussians with reordered axes, or its other primitives."""
        primitives = self.source.primitives(want, ctx)
        return with_shortest_third(primitives) if want == Quantity.GAUSSIANS else primitives

    @override
    def primitive_count(self) -> int | None:
        """The source's."""
        return self.source.primitive_count()

    @override
    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """The source's."""
        return self.source.state_dict(*args, **kwargs)

    @override
    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Load the source's."""
        return self.source.load_state_dict(*args, **kwargs)
