"""Sparse depth supervision: rays through points of structure from motion end there (Deng et al. 2022, DS-NeRF).

Few photographs can be explained by a fog before each camera that no other photograph shows. Tracks of structure from motion
list the photographs that show a point: the ray from such a camera passes what is before the point, and ends there. Fields that
start from these points have that built in; ray-marched ones learn it by a penalty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Context, Field, RayRenderer, Rays, Renderer, Scene
from invgraphics.errors import InputError

SPAN = 0.5
"""Share of a point's distance at which the error of a termination saturates: some points are wrong."""


@dataclass(frozen=True)
class SparseDepthConfig:
    """Supervision of depth at points of structure from motion.

    Attributes:
        weight: factor of the penalty; 0 leaves it out. On fox, dtu_scan24, bonsai_photos, colmap_statue and colmap_beer 0.1
            gains 3.1, 2.6, 1.9, 1.7 and -0.2 dB, and 1.0 3.2, 2.9, 1.5, 1.1 and -0.4 (volumetric/hash, 480 px, 1,700 steps).
        rays: rays through points in each step, beside those of the batch. 32 do as much as 128 or 256 (fox, colmap_statue),
            which take up to two fifths of a step's time where batches are small.
    """

    weight: float = 0.1
    rays: int = 32

    def __post_init__(self) -> None:
        if self.weight < 0 or self.rays < 1:
            raise ValueError("'weight' must not be negative, and 'rays' at least 1.")


@dataclass(frozen=True, eq=False)
class SparseDepth:
    """Penalty: the expected relative error of the termination distance of rays through known points, their mean.

    A ray terminates in a sample with the probability of its weight. The error is |t - d| / (`SPAN` d), at most 1, for a point
    at distance d; a ray that does not terminate has an error of 1. (DS-NeRF takes a KL divergence from a Gaussian around the
    point instead.)

    Attributes:
        config: settings.
        rays: from training cameras through points that their photographs show, clipped to the bounds.
        distance: of the point on each ray, local units.
    """

    config: SparseDepthConfig
    rays: Rays
    distance: Float[Tensor, " n"]

    @property
    def note(self) -> str:
        """What is supervised, in words."""
        views = len(self.rays.view.unique())
        return f"{len(self.rays):,} rays of {views} training photographs end at points of structure from motion"

    def to(self, device: torch.device) -> SparseDepth:
        """Move all tensors."""
        return replace(self, rays=self.rays.to(device), distance=self.distance.to(device))

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean over random rays."""
        assert isinstance(renderer, RayRenderer)
        chosen = torch.randint(len(self.rays), (self.config.rays,), generator=ctx.generator).to(self.distance.device)
        distance = self.distance[chosen]
        _, trace = renderer.render_rays(field, self.rays[chosen], ctx)
        assert trace.samples is not None
        assert trace.weights is not None
        at = distance[trace.samples.ray]
        error = ((trace.samples.mid - at).abs() / (SPAN * at)).clamp_max(1)
        return self.config.weight * (1 + (trace.weights * (error - 1)).sum() / len(chosen))


def make_sparse_depth(
    chosen: SparseDepthConfig | None, scene: Scene, renderer: Renderer, *, fixed_poses: bool = True
) -> SparseDepth | None:
    """Make the penalty of a fit; ``None`` for none.

    Args:
        chosen: of the recipe. Without any, depths are used where photographs of open space came with points that they show.
        scene: to fit.
        renderer: of the fit. Only volume rendering by samples along rays, of densities or distances, has use for depths.
        fixed_poses: whether cameras stay where they are; points were triangulated there.

    Raises:
        InputError: depths are requested, and cannot be used.
    """
    config = SparseDepthConfig() if chosen is None else chosen
    if config.weight == 0 or (chosen is None and scene.bounds.space != "contracted"):
        return None
    if not (isinstance(renderer, RayRenderer) and renderer.ends_in_samples):
        obstacle = "only volume rendering by samples along rays has use for depths"
    elif not fixed_poses:
        obstacle = "poses are optimised, and points were triangulated at the given ones"
    else:
        rays, distance = _through_landmarks(scene)
        if len(rays):
            return SparseDepth(config, rays, distance)
        obstacle = f"the training photographs of '{scene.name}' show no known points"
    if chosen is not None:
        raise InputError(f"training.sparse_depth cannot be used: {obstacle}.", "Leave it out, or find points by data.init=sfm.")
    return None


def _through_landmarks(scene: Scene) -> tuple[Rays, Float[Tensor, " n"]]:
    """Rays from training cameras through their landmarks within the bounds and at valid pixels, and the distances."""
    found, distances = [], []
    for index, view in enumerate(scene.train):
        camera = view.camera
        points = camera.position.new_zeros(0, 3) if view.landmarks is None else view.landmarks.to(camera.position)
        seen, pixel = camera.pixel_of(points)
        seen &= view.valid().reshape(-1)[pixel]
        found.append(camera.rays(camera.project(points[seen])[0], index))
        distances.append((points[seen] - camera.position).norm(dim=1))
    rays, distance = scene.bounds.clip(Rays.cat(found)), torch.cat(distances)
    inside = (distance > rays.near) & (distance < rays.far)
    return rays[inside], distance[inside]
