"""Rays: half-lines with an interval, a footprint and the view they came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rays:
    """A packed set of n rays in the scene's local frame.

    Attributes:
        origins: start points.
        directions: unit directions.
        near: distance along the ray where sampling may begin.
        far: distance where it must end; ``far <= near`` marks a ray that misses the scene.
        radius: radius of a pixel's footprint at distance 1 (mip-NeRF's base radius), for cones.
        view: index of the training view a ray came from, -1 where there is none.
    """

    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]
    radius: Float[Tensor, " n"]
    view: Int[Tensor, " n"]

    @staticmethod
    def make(
        origins: Float[Tensor, "n 3"],
        directions: Float[Tensor, "n 3"],
        radius: Float[Tensor, " n"] | float = 0.0,
        view: Int[Tensor, " n"] | int = -1,
    ) -> Rays:
        """Rays over [0, inf); scalars are repeated for every ray."""
        n = len(origins)
        return Rays(
            origins=origins,
            directions=directions,
            near=origins.new_zeros(n),
            far=origins.new_full((n,), torch.inf),
            radius=radius if isinstance(radius, Tensor) else origins.new_full((n,), radius),
            view=view if isinstance(view, Tensor) else torch.full((n,), view, device=origins.device),
        )

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return Rays(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    @staticmethod
    def cat(parts: Sequence[Rays]) -> Rays:
        """Join sets of rays, in order."""
        return Rays(**{field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Rays)})

    def at(self, t: Float[Tensor, "*n"]) -> Float[Tensor, "*n 3"]:
        """Points at distance ``t`` along each ray."""
        shape = (len(self),) + (1,) * (t.ndim - 1) + (3,)
        return self.origins.view(shape) + t[..., None] * self.directions.view(shape)

    def within(self, near: Float[Tensor, " n"], far: Float[Tensor, " n"]) -> Rays:
        """The same rays over another interval."""
        return replace(self, near=near, far=far)

    def chunks(self, size: int) -> Iterator[Rays]:
        """Consecutive parts of at most ``size`` rays."""
        for start in range(0, len(self), size):
            yield self[start : start + size]

    def to(self, *args: Any) -> Rays:
        """Move all tensors, or cast those that are floating-point."""
        moved = {field.name: getattr(self, field.name) for field in fields(self)}
        device = next((arg for arg in args if isinstance(arg, torch.device | str)), self.view.device)
        moved = {name: value.to(*args) if value.is_floating_point() else value.to(device) for name, value in moved.items()}
        return Rays(**moved)
