"""Regularisers of a signed distance: a gradient of length 1 (Gropp et al. 2020, IGR, equation 2), and little curvature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Batch, Bounds, Context, Field, Quantity, Renderer, Rendering, Samples, Trace
from invgraphics.errors import InputError
from invgraphics.training.checks import Requirement

DISTANCE = Requirement("a signed distance", quantities=Quantity.SDF | Quantity.GRADIENT)
"""For penalties that need a signed distance."""


@dataclass(frozen=True)
class EikonalPenalty:
    """Mean of (|∇f| - 1)² at random points of the bounds' box and at points near the surface, see `eikonal_mean`.

    A point near the surface is the foot of a random one, x - f ∇f / |∇f|², moved at random: VolSDF takes a uniform point
    and the sample next to the surface of every ray, which a penalty, without rays, does not have.

    Attributes:
        weight: factor (VolSDF, NeuS: 0.1).
        points: number of random points a step.
        near: number of points near the surface, at most ``points``.
        spread: standard deviation of these about the surface, in half-extents of the box.
    """

    name: ClassVar[str] = "eikonal"
    requires: ClassVar[Requirement] = DISTANCE

    weight: float = 0.1
    points: int = 1024
    near: int = 1024
    spread: float = 0.02

    def __post_init__(self) -> None:
        if self.weight < 0 or self.spread < 0:
            raise ValueError("'weight' and 'spread' must not be negative.")
        if self.points < 1 or not 0 <= self.near <= self.points:
            raise ValueError("'points' must be at least 1, and 'near' from 0 to 'points'.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean."""
        lo, hi = ctx.bounds.lo, ctx.bounds.hi
        position = torch.lerp(lo, hi, ctx.rand((self.points, 3), like=lo))
        values = field.query(Samples.at(position), Quantity.SDF | Quantity.GRADIENT)
        assert values.sdf is not None
        assert values.gradient is not None
        gradient = values.gradient
        if self.near:
            kept = slice(self.near)
            feet = near_surface(position[kept], values.sdf[kept], gradient[kept], self.spread, ctx)
            near = field.query(Samples.at(feet), Quantity.GRADIENT).gradient
            assert near is not None
            gradient, position = torch.cat([gradient, near]), torch.cat([position, feet])
        return self.weight * eikonal_mean(gradient, position, ctx.bounds)


@dataclass(frozen=True)
class CurvaturePenalty:
    """Mean |∇²f| near the surface: of a distance, the sum of the principal curvatures (Neuralangelo, Li et al. 2023, §3.3).

    The Laplacian is one of central differences: detail finer than their distance is averaged. Points near the surface
    are those of `EikonalPenalty`.

    Attributes:
        weight: factor (Neuralangelo: 5e-4), for curvatures per half-extent of the box.
        points: number of points a step.
        spread: standard deviation of these about the surface, in half-extents of the box.
        step: distance of the differences, in half-extents of the box (Neuralangelo: a cell of its finest level).
        warmup: progress over which the weight grows from 0 (Neuralangelo: 0.01): the sphere at the start is bent, too.
    """

    name: ClassVar[str] = "curvature"
    requires: ClassVar[Requirement] = DISTANCE

    weight: float = 5e-4
    points: int = 512
    spread: float = 0.02
    step: float = 0.01
    warmup: float = 0.01

    def __post_init__(self) -> None:
        if self.weight < 0 or self.spread < 0 or self.warmup < 0:
            raise ValueError("'weight', 'spread' and 'warmup' must not be negative.")
        if self.points < 1 or self.step <= 0:
            raise ValueError("'points' must be at least 1, and 'step' above 0.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean."""
        lo, hi, half = ctx.bounds.lo, ctx.bounds.hi, ctx.bounds.half.mean()
        position = torch.lerp(lo, hi, ctx.rand((self.points, 3), like=lo))
        with torch.no_grad():
            values = field.query(Samples.at(position), Quantity.SDF | Quantity.GRADIENT)
        assert values.sdf is not None
        assert values.gradient is not None
        near = near_surface(position, values.sdf, values.gradient, self.spread, ctx)
        weight = self.weight * min(1.0, ctx.progress / self.warmup if self.warmup else 1.0)
        return weight * (laplacian(field, near, float(self.step * half)) * half).abs().mean()


@dataclass(frozen=True)
class EikonalLoss:
    """Mean of (|∇f| - 1)² at a step's samples, for renderers that query the gradient there anyway (NeuS); see `eikonal_mean`.

    Attributes:
        weight: factor (NeuS: 0.1).
    """

    weight: float = 0.1

    def __call__(self, rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean; 0 where no ray has a sample.

        Raises:
            InputError: the renderer did not query gradients.
        """
        gradient = None if trace.values is None else trace.values.gradient
        if gradient is None:
            raise InputError(
                "The loss 'eikonal' needs samples with gradients of a signed distance, which this renderer does not take.",
                "The penalty 'eikonal' takes points of its own.",
            )
        assert trace.samples is not None
        return self.weight * eikonal_mean(gradient, trace.samples.position, ctx.bounds)


def eikonal_mean(gradient: Float[Tensor, "m 3"], position: Float[Tensor, "m 3"], bounds: Bounds) -> Float[Tensor, ""]:
    """Mean of (|∇f| - 1)²; 0 of no points. In contracted space those of the unit ball count.

    Beyond it lengths are contracted, and so is what a network shows of a distance: a slope of 1 per local length would be one
    of up to |x|² in its coordinates.
    """
    residual = eikonal_residual(gradient)
    if bounds.space == "box":
        return residual.sum() / max(len(gradient), 1)
    within = bounds.radial_scale(position) == 1
    return (residual * within).sum() / within.sum().clamp_min(1)


def eikonal_residual(gradient: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """(|∇f| - 1)²."""
    return (gradient.norm(dim=1) - 1).square()


def laplacian(field: Field, position: Float[Tensor, "m 3"], step: float) -> Float[Tensor, " m"]:
    """Laplacian of the signed distance by central differences over ``step``, per local length; it is in the graph.

    Args:
        field: with a signed distance.
        position: of m points.
        step: distance of the differences, local units.
    """
    shift = step * torch.eye(3, dtype=position.dtype, device=position.device)
    places = torch.stack([position, *(position + sign * axis for axis in shift for sign in (1, -1))])
    values = field.query(Samples.at(places.flatten(0, 1)), Quantity.SDF).sdf
    assert values is not None
    middle, *around = values.view(7, -1)
    return (torch.stack(around).sum(dim=0) - 6 * middle) / step**2


@torch.no_grad()
def near_surface(
    position: Float[Tensor, "m 3"], sdf: Float[Tensor, " m"], gradient: Float[Tensor, "m 3"], spread: float, ctx: Context
) -> Float[Tensor, "m 3"]:
    """Feet of points on the surface, moved at random by ``spread`` half-extents of the box, inside it."""
    lo, hi = ctx.bounds.lo, ctx.bounds.hi
    # Sums of three uniform numbers are as good as normal ones, and come from the context's generator.
    noise = 2 * ctx.rand((3, *position.shape), like=lo).sum(dim=0) - 3
    return (foot_points(position, sdf, gradient) + spread * ctx.bounds.half.mean() * noise).clamp(lo, hi)


def foot_points(
    position: Float[Tensor, "m 3"], sdf: Float[Tensor, " m"], gradient: Float[Tensor, "m 3"]
) -> Float[Tensor, "m 3"]:
    """Nearest points on the surface, by one step of Newton's method; exact for a distance."""
    return position - (sdf / gradient.square().sum(dim=1).clamp_min(1e-6))[:, None] * gradient
