"""Errors of estimated camera poses after alignment by a similarity (the gauge freedom of structure from motion).

Structure from motion and joint optimisation know the world up to a similarity (gauge freedom), so estimated poses are moved by
the best one first: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", on the
camera centres, in float64. Cameras on a line (or all in one place) leave a turn undecided; there the orientations decide too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.transforms import rigid, transform_points

THINNEST = 0.05
"""Spread of camera centres across their main axis, relative to that along it, below which they count as lying on a line."""

ROUNDING = 1e-12
"""Spread of camera centres over their distance from the origin, below which all stand in one place."""

MARGIN = 1.1
"""Extent of a set of cameras over the largest distance of one from their mean: 3DGS's, as in `Scene.extent`."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """``target = scale * rotation @ source + translation``, float64."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, 3]

    @property
    def matrix(self) -> Float[Tensor, "4 4"]:
        """Affine 4 x 4 matrix of the similarity, for `invgraphics.core.transforms`."""
        return rigid(self.scale * self.rotation, self.translation)

    def inverse(self) -> Similarity:
        """The similarity from the target back to the source."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def points(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform points."""
        return transform_points(self.matrix, points.double())

    def poses(self, cam_to_world: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n 4 4"]:
        """Transform cameras: their positions are scaled, their axes stay orthonormal."""
        moved = cam_to_world.double().clone()
        moved[..., :3, :3] = self.rotation @ moved[..., :3, :3]
        moved[..., :3, 3] = self.points(cam_to_world[..., :3, 3])
        return moved


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of each camera after alignment.

    Attributes:
        rotation_degrees: angle between estimated and true orientation.
        translation_per_cent: distance between estimated and true centre, per cent of ``extent``.
        scale: true length of one unit of the estimate.
        extent: of the true scene, its units.
        similarity: the alignment applied to the estimate.
    """

    rotation_degrees: Float[Tensor, " n"]
    translation_per_cent: Float[Tensor, " n"]
    scale: float
    extent: float
    similarity: Similarity

    def summary(self) -> dict[str, Any]:
        """Median, mean and largest errors as plain numbers, for a JSON file."""
        kinds = {"rotation_degrees": self.rotation_degrees, "translation_per_cent": self.translation_per_cent}
        table: dict[str, Any] = {
            name: {"median": float(values.quantile(0.5)), "mean": float(values.mean()), "max": float(values.max())}
            for name, values in kinds.items()
        }
        return {"cameras": len(self.rotation_degrees), **table, "scale": self.scale, "extent": self.extent}


def align_similarity(
    source_centres: Float[Tensor, "n 3"],
    target_centres: Float[Tensor, "n 3"],
    source_rotations: Float[Tensor, "n 3 3"] | None = None,
    target_rotations: Float[Tensor, "n 3 3"] | None = None,
) -> Similarity:
    """Least-squares similarity from the source's camera centres to the target's (Umeyama 1991).

    Umeyama's closed form decides alone where the centres span at least a plane. Where either set lies on a line (`THINNEST`)
    and orientations are given, the relative rotations ``target_rotation @ source_rotation.T`` have as much say about the
    rotation as the centres. All centres in one place leave the scale at 1.

    Args:
        source_centres: estimated positions.
        target_centres: true positions, in the same order.
        source_rotations: camera-to-world rotations of the estimate.
        target_rotations: true ones.

    Raises:
        ValueError: no cameras, or not as many in both.
    """
    source, target = source_centres.double(), target_centres.double()
    if len(source) == 0 or source.shape != target.shape:
        raise ValueError(f"cannot align {tuple(source.shape)} centres with {tuple(target.shape)}")
    source_mean, target_mean = source.mean(dim=0), target.mean(dim=0)
    source, target = source - source_mean, target - target_mean
    covariance = target.T @ source / len(source)
    spreads = [float(points.square().sum(dim=1).mean().sqrt()) for points in (source, target)]
    place = sum(float(mean.abs().max()) for mean in (source_mean, target_mean))
    apart = min(spreads) > ROUNDING * (place + max(spreads))
    evidence = covariance / (spreads[0] * spreads[1]) if apart else torch.zeros_like(covariance)
    if source_rotations is not None and target_rotations is not None and min(map(_width, (source, target))) < THINNEST:
        evidence = evidence + (target_rotations.double() @ source_rotations.double().mT).mean(dim=0)
    rotation = _nearest_rotation(evidence)
    # Umeyama's eq. 42; where orientations overrule the centres its numerator may vanish, not so the ratio of the spreads.
    scale = float((rotation * covariance).sum()) / spreads[0] ** 2 if apart else 1.0
    scale = scale if scale > 0 else spreads[1] / spreads[0]
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def align_poses(estimated: Float[Tensor, "n 4 4"], true: Float[Tensor, "n 4 4"]) -> Similarity:
    """`align_similarity` for camera-to-world poses in the same order, orientations included."""
    return align_similarity(estimated[:, :3, 3], true[:, :3, 3], estimated[:, :3, :3], true[:, :3, :3])


def pose_errors(
    estimated_cam_to_world: Float[Tensor, "n 4 4"], true_cam_to_world: Float[Tensor, "n 4 4"], extent: float | None = None
) -> PoseErrors:
    """Errors of estimated cameras after aligning them with the true ones.

    Args:
        estimated_cam_to_world: poses in any world that a similarity takes to the true one.
        true_cam_to_world: in the same order.
        extent: what counts as 100 per cent, in true units; `camera_extent` of the true cameras if not given.
    """
    similarity = align_poses(estimated_cam_to_world, true_cam_to_world)
    true = true_cam_to_world.double()
    moved = similarity.poses(estimated_cam_to_world)
    extent = camera_extent(true) if extent is None else extent
    distance = (moved[:, :3, 3] - true[:, :3, 3]).norm(dim=1)
    return PoseErrors(
        rotation_degrees=rotation_angle(moved[:, :3, :3], true[:, :3, :3]),
        translation_per_cent=100 * distance / extent,
        scale=similarity.scale,
        extent=extent,
        similarity=similarity,
    )


def camera_extent(cam_to_world: Float[Tensor, "n 4 4"]) -> float:
    """The extent of a set of cameras in their units, by the rule of `Scene.extent`; 1 where all stand in one place."""
    centres = cam_to_world[:, :3, 3].double()
    middle = centres.mean(dim=0)
    spread = float((centres - middle).norm(dim=1).max())
    return MARGIN * spread if spread > ROUNDING * (float(middle.norm()) + spread) else 1.0


def rotation_angle(first: Float[Tensor, "*n 3 3"], second: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n"]:
    """Angle in degrees of the rotation between two orientations, exact near 0 and 180 degrees too."""
    turn = first.double() @ second.double().mT
    # ‖R - Rᵀ‖ = 2√2 sin θ and tr R = 1 + 2 cos θ; arccos alone would lose half the digits of a small angle.
    sine = (turn - turn.mT).flatten(-2).norm(dim=-1) / 8**0.5
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2
    return torch.rad2deg(torch.atan2(sine, cosine))


def _width(centred: Float[Tensor, "n 3"]) -> float:
    """Ratio of the second to the first singular value of centred points: 0 for points on a line."""
    if len(centred) < 2:
        return 0.0
    values = torch.linalg.svdvals(centred)
    return float(values[1] / values[0]) if float(values[0]) > 0 else 0.0


def _nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Orthogonal Procrustes: the rotation R that maximises the trace of Rᵀ ``matrix``."""
    u, _, vh = torch.linalg.svd(matrix)
    signs = matrix.new_tensor([1.0, 1.0, float(torch.linalg.det(u @ vh).sign())])
    return u * signs @ vh
