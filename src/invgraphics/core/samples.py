"""Packed samples along rays, and a field's values at samples."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core.rays import Rays


@dataclass(frozen=True, eq=False)
class Samples:
    """m intervals [t0, t1] on n rays, packed and sorted by ray, then by distance.

    Attributes:
        ray: index of each sample's ray, non-decreasing.
        t0: where the interval begins, distance along the ray.
        t1: where it ends.
        position: representative point, the interval's middle; of its cone it is `cone_mean`.
        direction: unit direction of the ray.
        radius: pixel footprint of the ray at distance 1.
        view: training-view index of the ray, -1 where there is none.
        density: the field's density as the sampler has queried it, outside the graph; ``None`` where it did not.
        features: the field's features from the same query, from which it evaluates radiance without another look-up.
    """

    ray: Int[Tensor, " m"]
    t0: Float[Tensor, " m"]
    t1: Float[Tensor, " m"]
    position: Float[Tensor, "m 3"]
    direction: Float[Tensor, "m 3"]
    radius: Float[Tensor, " m"]
    view: Int[Tensor, " m"]
    density: Float[Tensor, " m"] | None = None
    features: Float[Tensor, "m f"] | None = None

    @staticmethod
    def on(rays: Rays, ray: Int[Tensor, " m"], t0: Float[Tensor, " m"], t1: Float[Tensor, " m"]) -> Samples:
        """Samples from intervals on ``rays``."""
        direction = rays.directions[ray]
        position = torch.addcmul(rays.origins[ray], ((t0 + t1) / 2)[:, None], direction)
        return Samples(ray, t0, t1, position, direction, rays.radius[ray], rays.view[ray])

    @staticmethod
    def at(position: Float[Tensor, "m 3"], direction: Float[Tensor, "m 3"] | None = None) -> Samples:
        """Points without rays, for field queries outside a rendering; without ``direction`` it is +z."""
        m, none = len(position), torch.zeros_like(position[:, 0])
        if direction is None:
            direction = position.new_tensor([0.0, 0.0, 1.0]).expand(m, 3)
        index = torch.arange(m, device=position.device)
        return Samples(index, none, none, position, direction, none, torch.full_like(index, -1))

    def __len__(self) -> int:
        return len(self.t0)

    def __getitem__(self, index: slice | Int[Tensor, " k"] | Bool[Tensor, " m"]) -> Samples:
        always = (field.name for field in fields(self) if field.name not in ("density", "features"))
        density, features = (None if known is None else known[index] for known in (self.density, self.features))
        return Samples(**{name: getattr(self, name)[index] for name in always}, density=density, features=features)

    @property
    def mid(self) -> Float[Tensor, " m"]:
        """Distance of each interval's middle."""
        return (self.t0 + self.t1) / 2

    @property
    def delta(self) -> Float[Tensor, " m"]:
        """Length of each interval."""
        return self.t1 - self.t0

    @property
    def cone_mean(self) -> Float[Tensor, "m 3"]:
        """Mean of the cone frustum behind each sample (mip-NeRF, equation 7); the position itself for a lone point.

        A frustum is wider at its far end, so that its mean is farther than the interval's middle.
        """
        middle, half = self.mid, self.delta / 2
        beyond = 2 * middle * half**2 / (3 * middle**2 + half**2).clamp_min(torch.finfo(half.dtype).tiny)
        return torch.addcmul(self.position, beyond[:, None], self.direction)

    @property
    def covariance(self) -> Float[Tensor, "m 3 3"]:
        """Covariance of the cone frustum behind each sample (mip-NeRF, equations 7 and 8 and 14); zero for a lone point."""
        middle, half = self.mid, self.delta / 2
        share = half**2 / (3 * middle**2 + half**2).clamp_min(torch.finfo(half.dtype).tiny)
        along = half**2 / 3 - (4 / 15) * share**2 * (12 * middle**2 - half**2)
        across = self.radius**2 * (middle**2 / 4 + (5 / 12) * half**2 - (4 / 15) * half**2 * share)
        outer = self.direction[:, :, None] * self.direction[:, None, :]
        eye = torch.eye(3, dtype=outer.dtype, device=outer.device)
        return along[:, None, None] * outer + across[:, None, None] * (eye - outer)


@dataclass(frozen=True, eq=False)
class FieldValues:
    """Values of a field at m samples; quantities that were not queried are ``None``.

    Attributes:
        density: volume density, per local length unit, >= 0.
        sdf: signed distance, local units, negative inside.
        gradient: gradient of the signed distance in the position, not normalised: of length 1 only where ``sdf`` is a distance.
        radiance: colour seen along the sample's direction, in the scene's colour space, [0, 1] for sRGB.
        normal: unit normal, pointing out of the surface; zero where it is undefined (constant density). With a signed distance,
            its normalised gradient.
        features: anything else a renderer and a field agree on.
    """

    density: Float[Tensor, " m"] | None = None
    sdf: Float[Tensor, " m"] | None = None
    gradient: Float[Tensor, "m 3"] | None = None
    radiance: Float[Tensor, "m 3"] | None = None
    normal: Float[Tensor, "m 3"] | None = None
    features: Float[Tensor, "m f"] | None = None
