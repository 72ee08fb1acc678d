"""The region a field describes, and the map from it to the unit cube in which encodings live."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.rays import Rays

Space = Literal["box", "contracted"]

CONTRACTED_FAR = 1e3
"""Where contracted rays end, in half-extents of the inner box: the remaining shell is 1/1000 of the contracted radius."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """An axis-aligned box in the local frame; all there is (``box``) or the detailed core of all space (``contracted``).

    Attributes:
        lo: lowest corner.
        hi: highest corner.
        space: ``box`` ends rays at the box; ``contracted`` maps all space into a ball of twice the box's size
            (mip-NeRF 360, equation 10).
        near: no sample is taken closer to a camera than this, in local units.
        crop: lowest and highest corner of a box outside which rays have no samples; the field's coordinates do not depend on
            it (instant-ngp's render_aabb). ``None`` for no crop.
    """

    lo: Float[Tensor, 3]
    hi: Float[Tensor, 3]
    space: Space = "box"
    near: float = 0.05
    crop: tuple[Float[Tensor, 3], Float[Tensor, 3]] | None = None

    @property
    def centre(self) -> Float[Tensor, 3]:
        """Centre of the box."""
        return (self.lo + self.hi) / 2

    @property
    def half(self) -> Float[Tensor, 3]:
        """Half the box's edges."""
        return (self.hi - self.lo) / 2

    @property
    def radius(self) -> float:
        """Half the box's diagonal, in local units."""
        return float(self.half.norm())

    def to_unit(self, position: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3"]:
        """Map positions to the unit cube. In a box, points outside it fall outside [0, 1]."""
        x = (position - self.centre) / self.half
        return (contract(x) / 2 + 1) / 2 if self.space == "contracted" else (x + 1) / 2

    def from_unit(self, unit: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3"]:
        """Inverse of `to_unit`; corners of the cube beyond the contracted ball are pulled onto its rim."""
        x = uncontract((unit * 2 - 1) * 2) if self.space == "contracted" else unit * 2 - 1
        return self.centre + x * self.half

    def vertices(self, resolution: Sequence[int]) -> Float[Tensor, "n 3"]:
        """Positions of a voxel grid's vertices, of which the outermost lie on the unit cube's faces; z runs fastest.

        Args:
            resolution: vertices along x, y and z.
        """
        axes = [torch.linspace(0, 1, size, device=self.lo.device, dtype=self.lo.dtype) for size in resolution]
        position = self.from_unit(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3))
        # Rounding must not put those of a box outside it, where a field has no density.
        return position.clamp(self.lo, self.hi) if self.space == "box" else position

    def cell_centres(self, resolution: Sequence[int]) -> Float[Tensor, "n 3"]:
        """Positions of the centres of a box's cells, none of them on a face; z runs fastest.

        Args:
            resolution: cells along x, y and z.
        """
        half = self.half / torch.tensor(resolution, dtype=self.lo.dtype, device=self.lo.device)
        return Bounds(self.lo + half, self.hi - half).vertices(resolution)

    def unit_covariance(self, position: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"]) -> Float[Tensor, "m 3 3"]:
        """Transform covariances to the unit cube by the linearised map, J Σ Jᵀ (mip-NeRF 360, equation 9).

        Args:
            position: means, where the map is linearised; differentiable.
            covariance: in local units squared, symmetric.
        """
        scaled = covariance / (self.half[:, None] * self.half)
        if self.space == "box":
            return scaled / 4
        jacobian = contract_jacobian((position - self.centre) / self.half) / 4
        return jacobian @ scaled @ jacobian

    def radial_scale(self, position: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m"]:
        """Contracted length per length along the radius, 1 / |x|² outside the unit ball; 1 inside it and in a box."""
        if self.space == "box":
            return torch.ones_like(position[..., 0])
        x, y, z = ((position - self.centre) / self.half).unbind(dim=-1)
        return 1 / (x * x + y * y + z * z).clamp_min(1.0)

    def contains(self, position: Float[Tensor, "*m 3"]) -> Tensor:
        """Whether a position is described by the field (everything, in a contracted space)."""
        if self.space == "contracted":
            return torch.ones_like(position[..., 0], dtype=torch.bool)
        # Column by column: a reduction over three numbers is slow on CPUs.
        x, y, z = ((position >= self.lo) & (position <= self.hi)).unbind(dim=-1)
        return x & y & z

    def clip(self, rays: Rays) -> Rays:
        """Clip rays to the region, and to ``crop``.

        The region is the box; in contracted space, distances from ``near`` to `CONTRACTED_FAR` half-extents.

        A ray that misses the box gets ``far = near``.
        """
        rays = self._clip_to_field(rays)
        return rays if self.crop is None else _clip_to_box(rays, *self.crop)

    def _clip_to_field(self, rays: Rays) -> Rays:
        if self.space == "contracted":
            far = CONTRACTED_FAR * float(self.half.max())
            return rays.within(rays.near.clamp_min(self.near), rays.far.clamp_max(far))
        return _clip_to_box(rays.within(rays.near.clamp_min(self.near), rays.far), self.lo, self.hi)

    def to(self, *args: Any) -> Bounds:
        """Move or cast the tensors."""
        crop = None if self.crop is None else (self.crop[0].to(*args), self.crop[1].to(*args))
        return replace(self, lo=self.lo.to(*args), hi=self.hi.to(*args), crop=crop)


def _clip_to_box(rays: Rays, lo: Float[Tensor, 3], hi: Float[Tensor, 3]) -> Rays:
    """Intersect the rays' intervals with a box."""
    # Slab test. An axis-parallel ray gets a tiny slope instead of 0: on a face of the box, 0 / 0 would be NaN.
    direction = torch.where(rays.directions == 0, torch.full_like(rays.directions, 1e-20), rays.directions)
    a, b = (lo - rays.origins) / direction, (hi - rays.origins) / direction
    near = torch.minimum(a, b).amax(dim=1).maximum(rays.near)
    far = torch.maximum(a, b).amin(dim=1).minimum(rays.far)
    return rays.within(near, far.maximum(near))


def contract(x: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3"]:
    """Mip-NeRF 360's contraction (equation 10): identity in the unit ball, all space outside into the shell up to radius 2."""
    # Clamped inside the ball so that the unused branch of `where` has finite gradients.
    squared = x.square().sum(dim=-1, keepdim=True).clamp_min(1.0)
    norm = squared.sqrt()
    return torch.where(squared > 1, (2 - 1 / norm) * (x / norm), x)


def contract_jacobian(x: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3 3"]:
    """Jacobian of `contract`, symmetric: with n = |x| > 1 and u = x / n, (2 - 1/n)/n across u and 1/n² along it.

    On the unit sphere, where both sides of the map meet, it is the identity from either side.
    """
    squared = x.square().sum(dim=-1, keepdim=True).clamp_min(1.0)
    across = 2 / squared.sqrt() - 1 / squared
    unit = torch.where(squared > 1, x, 0.0) / squared.sqrt()
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    excess = (1 / squared - across) * unit
    return across[..., None] * eye + excess[..., :, None] * unit[..., None, :]


def uncontract(y: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3"]:
    """Inverse of `contract`, with radii clamped below 2."""
    norm = y.norm(dim=-1, keepdim=True).clamp(1.0, 2 - 1 / CONTRACTED_FAR)
    unit = y / y.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.where(y.norm(dim=-1, keepdim=True) > 1, unit / (2 - norm), y)
