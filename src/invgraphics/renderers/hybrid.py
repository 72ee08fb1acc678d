"""Volume rendering of surfaces: a density is derived from a signed distance, and its width found by the fit."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Literal, Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import (
    Camera,
    Context,
    Contributions,
    Field,
    Quantity,
    RayRenderer,
    Rays,
    Rendering,
    Sampler,
    Samples,
    Scene,
    Trace,
)
from invgraphics.core.camera import pixel_size
from invgraphics.renderers.distance_density import DistanceDensity
from invgraphics.renderers.quadrature import heaviest_of_rays, sample_weights
from invgraphics.renderers.volumetric import Volumetric

Change = Literal["learnt", "scheduled", "held"]
"""How the density's width evolves during a fit: learnt by gradient, on a log-linear schedule, or fixed."""


class HybridSettings(Protocol):
    """Settings that all renderers of this family share."""

    @property
    def change(self) -> Change:
        """How the width evolves during a fit."""
        ...

    @property
    def min_deviation(self) -> float:
        """Least standard deviation of the density's distribution on a schedule, in pixels."""
        ...

    @property
    def widths(self) -> tuple[float, float]:
        """The density's width at the start, and the one at the end or in an untrained renderer, in half-extents of the box."""
        ...

    def to_parameter(self, width: float) -> float:
        """Value of the parameter for a width in half-extents."""
        ...

    def to_width(self, parameter: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Inverse of `to_parameter`."""
        ...


class Hybrid(RayRenderer):
    """Volume renderer of a density derived from a signed distance; `VolSDF` and `NeuS` choose which.

    Args:
        settings: the width and how it evolves.
        volumetric: renders the density, with a sampler of its own.

    Attributes:
        width: the parameter of the density's width (see `HybridSettings.to_parameter`); it has a gradient only if it is learnt.
    """

    requires: ClassVar[Quantity] = Quantity.SDF | Quantity.RADIANCE
    ends_in_samples: ClassVar[bool] = True

    def __init__(self, settings: HybridSettings, volumetric: Volumetric) -> None:
        super().__init__()
        self.volumetric = volumetric
        self._settings = settings
        self.width = nn.Parameter(torch.tensor(settings.to_parameter(settings.widths[0])))

    @property
    @override
    def required(self) -> Quantity:
        return self.requires | self.volumetric.sampler.requires

    @abstractmethod
    def density(self, field: Field, ctx: Context, *, on_rays: bool = True) -> DistanceDensity:
        """The field as one of densities; ``on_rays`` is false for queries at isolated points (occupancy refresh)."""

    @abstractmethod
    def untrained(self) -> Self:
        """Copy with the constant width, and the sampler's constants, in place of learnt state."""

    def beta(self, ctx: Context) -> Float[Tensor, ""]:
        """The density's width now, local units; in the graph if it is learnt."""
        parameter = self.width if self._settings.change == "learnt" else self.width.detach()
        return self._settings.to_width(parameter) * ctx.bounds.half.mean()

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
        """Set a scheduled width, and refresh the sampler's state by the density of that width."""
        if self._settings.change == "scheduled":
            first, last = self._settings.widths
            self.width.fill_(self._settings.to_parameter(first * (last / first) ** ctx.progress))
        self.volumetric.update(self.density(field, ctx, on_rays=False), ctx)


class WeightThresholdSampler(Sampler):
    """Another sampler's samples, in training without those of negligible weight by the densities that it queried anyway.

    Near a sharp surface few samples have any weight, and the gradients of the others are not worth their cost: the
    derivative of a density's tail is as small as the tail. Each ray keeps its heaviest sample, however light: a ray without
    samples has no gradient, and could not bring back a surface where a mask demands one.

    Args:
        sampler: the other; samples that come without densities are all kept.
        threshold: weights up to this are left out.
    """

    def __init__(self, sampler: Sampler, threshold: float) -> None:
        super().__init__()
        self.sampler = sampler
        self.threshold = threshold

    @property
    @override
    def requires(self) -> Quantity:
        return self.sampler.requires

    @override
    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        samples, levels = self.sampler.sample(rays, field, ctx)
        if samples.density is None or not ctx.training:
            return samples, levels
        with torch.no_grad():
            weights = sample_weights(samples.density, samples, len(rays))
            kept = torch.nonzero((weights > self.threshold) | heaviest_of_rays(weights, samples.ray, len(rays)))[:, 0]
        return samples[kept], levels

    @override
    def update(self, field: Field, ctx: Context) -> None:
        self.sampler.update(field, ctx)

    @override
    def untrained(self) -> WeightThresholdSampler:
        return WeightThresholdSampler(self.sampler.untrained(), self.threshold)


def make_volumetric(sampler: Sampler, gradient_reach: float, weight_threshold: float) -> Volumetric:
    """Volume renderer with a sampler whose samples weigh more than ``weight_threshold`` in training."""
    return Volumetric(WeightThresholdSampler(sampler, weight_threshold) if weight_threshold > 0 else sampler, gradient_reach)


def least_width(settings: HybridSettings, deviation: float, scene: Scene) -> float:
    """Width that a schedule does not go below, in half-extents of the box; 0 without a schedule, a limit or training views.

    Args:
        settings: with the least standard deviation in pixels of the nearest training camera (`pixel_size`).
        deviation: standard deviation of the density's distribution, over its width.
        scene: whose training views resolve these pixels.
    """
    if settings.change != "scheduled" or not settings.min_deviation or not scene.train:
        return 0.0
    size = pixel_size(scene.bounds, [view.camera for view in scene.train])
    return settings.min_deviation * size / float(scene.bounds.half.mean()) / deviation


def check_settings(first: float, last: float, min_deviation: float, gradient_reach: float, weight_threshold: float) -> None:
    """Check settings that all renderers of this family have.

    Raises:
        ValueError: a width that is not positive, or a reach or threshold out of range.
    """
    if min(first, last) <= 0:
        raise ValueError("the width of a density, or its sharpness, must be above 0.")
    if min_deviation < 0:
        raise ValueError(f"min_deviation must not be negative, not {min_deviation}")
    if gradient_reach < 0:
        raise ValueError(f"gradient_reach must not be negative, not {gradient_reach}")
    if not 0 <= weight_threshold < 1:
        raise ValueError(f"weight_threshold must be in [0, 1), not {weight_threshold}")
