"""Volume rendering of surfaces: a density is made from a signed distance, and its width found by the fit."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Literal, Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import Camera, Context, Contributions, Field, Quantity, RayRenderer, Rays, Rendering, Trace
from invgraphics.renderers.distance_density import DistanceDensity
from invgraphics.renderers.volumetric import Volumetric

Change = Literal["learnt", "scheduled", "held"]
"""What becomes of a width during a fit: it follows its gradient, or a log-linear schedule, or stays."""


class HybridSettings(Protocol):
    """What all renderers of this family are configured by."""

    @property
    def change(self) -> Change:
        """What becomes of the width."""
        ...

    @property
    def widths(self) -> tuple[float, float]:
        """The density's width at the start, and the one at the end or in an untrained renderer, in half-extents of the box."""
        ...

    def stored(self, width: float) -> float:
        """What the parameter is for a width in half-extents."""
        ...

    def width_of(self, stored: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Inverse of `stored`."""
        ...


class Hybrid(RayRenderer):
    """Volume renderer of a density that a signed distance makes; `VolSDF` and `NeuS` say which.

    Args:
        settings: the width and what becomes of it.
        volumetric: renders the density, with a sampler of its own.

    Attributes:
        width: the density's width as the settings store it: a parameter, which has a gradient only if it is learnt.
    """

    requires: ClassVar[Quantity] = Quantity.SDF | Quantity.RADIANCE

    def __init__(self, settings: HybridSettings, volumetric: Volumetric) -> None:
        super().__init__()
        self.volumetric = volumetric
        self._settings = settings
        self.width = nn.Parameter(torch.tensor(settings.stored(settings.widths[0])))

    @property
    @override
    def required(self) -> Quantity:
        return self.requires | self.volumetric.sampler.requires

    @abstractmethod
    def density(self, field: Field, ctx: Context, *, on_rays: bool = True) -> DistanceDensity:
        """The field as one of densities; ``on_rays`` says whether its samples will lie on rays."""

    @abstractmethod
    def untrained(self) -> Self:
        """Copy with the constant width, and the sampler's constants, in place of learnt state."""

    def beta(self, ctx: Context) -> Float[Tensor, ""]:
        """The density's width now, local units; in the graph if it is learnt."""
        stored = self.width if self._settings.change == "learnt" else self.width.detach()
        return self._settings.width_of(stored) * ctx.bounds.half.mean()

    @override
    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; with normals if ``ctx.geometry`` is set and the field provides them."""
        return self.volumetric.render_rays(self.density(field, ctx), rays, ctx)

    @override
    @torch.no_grad()
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """The samples of the pixel's ray, and the density between them; see `Renderer.contributions`."""
        return self.volumetric.contributions(self.density(field, ctx), camera, pixel, ctx)

    @override
    @torch.no_grad()
    def update(self, field: Field, ctx: Context) -> None:
        """Set a scheduled width, and refresh the sampler's state by the density that it makes."""
        if self._settings.change == "scheduled":
            first, last = self._settings.widths
            self.width.fill_(self._settings.stored(first * (last / first) ** ctx.progress))
        self.volumetric.update(self.density(field, ctx, on_rays=False), ctx)


def check_settings(first: float, last: float, gradient_reach: float, colour_threshold: float) -> None:
    """Check settings that all renderers of this family have.

    Raises:
        ValueError: a width that is not positive, or a reach or threshold that volume rendering does not take.
    """
    if min(first, last) <= 0:
        raise ValueError("the width of a density, or its sharpness, must be above 0.")
    if gradient_reach < 0:
        raise ValueError(f"gradient_reach must not be negative, not {gradient_reach}")
    if not 0 <= colour_threshold < 1:
        raise ValueError(f"colour_threshold must be in [0, 1), not {colour_threshold}")
