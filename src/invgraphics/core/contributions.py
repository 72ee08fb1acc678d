"""What is composited into one pixel, renderer by renderer in one form, so that it can be listed and plotted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core.compositing import alphas_from_weights
from invgraphics.core.field import Field, Quantity
from invgraphics.core.rays import Rays
from invgraphics.core.rendering import Context, Trace
from invgraphics.core.samples import Samples
from invgraphics.core.spacing import from_spacing, to_spacing

POINTS = 512
"""Points of a profile."""


@dataclass(frozen=True, eq=False)
class Profile:
    """Density and transmittance of a ray at p distances, increasing.

    Attributes:
        t: distance along the ray, local units.
        density: per local unit; ``None`` where the field has none.
        transmittance: share of the light from t that reaches the camera.
    """

    t: Float[Tensor, " p"]
    density: Float[Tensor, " p"] | None
    transmittance: Float[Tensor, " p"]


@dataclass(frozen=True, eq=False)
class Pass:
    """The weights of an earlier pass (coarse or proposal) in its k intervals [t0, t1]."""

    t0: Float[Tensor, " k"]
    t1: Float[Tensor, " k"]
    weight: Float[Tensor, " k"]


@dataclass(frozen=True, eq=False)
class Contributions:
    """k contributions to one pixel, in the order in which the renderer composites them; colour = Σ weight rgb.

    Attributes:
        kind: what they are, in the plural, for titles: ``samples`` are intervals of a field; others (``splats``, ``Gaussians``)
            are drawn as points of the ray.
        t: distance along the ray: the interval's middle, or the largest response of a Gaussian.
        begin: where the interval begins; for Gaussians, one standard deviation nearer.
        end: where it ends; for Gaussians, one standard deviation farther.
        alpha: opacity of each by itself.
        transmittance: share of its light that the others let through.
        weight: share of the pixel's light; ``transmittance * alpha`` unless they overlap.
        rgb: colours in the scene's colour space.
        counted: whether the colour is in the pixel's sum; samples of negligible weight are left out.
        density: at the samples, per local unit.
        distance: mean distance of the light of each; ``None`` where that is ``t``.
        profile: density and transmittance in between.
        marched: for splats: the same Gaussians as overlapping densities, each with the optical depth of its alpha.
        passes: earlier passes of a sampler, first to last.
    """

    kind: str
    t: Float[Tensor, " k"]
    begin: Float[Tensor, " k"]
    end: Float[Tensor, " k"]
    alpha: Float[Tensor, " k"]
    transmittance: Float[Tensor, " k"]
    weight: Float[Tensor, " k"]
    rgb: Float[Tensor, "k 3"]
    counted: Bool[Tensor, " k"]
    density: Float[Tensor, " k"] | None = None
    distance: Float[Tensor, " k"] | None = None
    profile: Profile | None = None
    marched: Profile | None = None
    passes: tuple[Pass, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    @property
    def colour(self) -> Float[Tensor, " 3"]:
        """The pixel's colour, premultiplied."""
        return (torch.where(self.counted, self.weight, 0.0)[:, None] * self.rgb).sum(dim=0)

    @property
    def opacity(self) -> float:
        """The pixel's alpha."""
        return float(self.weight.sum())

    @property
    def expected_depth(self) -> float:
        """Mean distance of the light, Σ w t / Σ w with the ``distance`` of each; infinite where there is none."""
        distance = self.t if self.distance is None else self.distance
        return float((self.weight * distance).sum()) / self.opacity if self.opacity > 0 else math.inf

    @property
    def median_depth(self) -> float:
        """Where half of the light is gone; infinite where more than half goes through."""
        if self.profile is not None:
            t, transmittance = self.profile.t, self.profile.transmittance
        else:
            t, transmittance = self.t, self.transmittance * (1 - self.alpha)
        dark = (transmittance <= 0.5).nonzero()[:, 0]
        if not len(dark):
            return math.inf
        after = int(dark[0])
        if self.profile is None or after == 0:
            return float(t[after])
        high, low = float(transmittance[after - 1]), float(transmittance[after])
        return float(torch.lerp(t[after - 1], t[after], (high - 0.5) / max(high - low, 1e-12)))

    def to(self, device: torch.device | str) -> Contributions:
        """Move all tensors."""

        def moved(value: Any) -> Any:
            if isinstance(value, Tensor):
                return value.to(device)
            if isinstance(value, tuple):
                return tuple(moved(item) for item in value)
            if isinstance(value, Profile | Pass):
                return type(value)(**{name: moved(item) for name, item in vars(value).items()})
            return value

        return Contributions(**{name: moved(value) for name, value in vars(self).items()})


@torch.no_grad()
def sampled_contributions(field: Field, trace: Trace, rays: Rays, ctx: Context) -> Contributions:
    """The samples of one ray, and the field's density in between.

    Args:
        field: what was sampled.
        trace: of the ray, with samples, radiance and weights.
        rays: the one ray.
        ctx: under which it was rendered.
    """
    samples, values, weight = trace.samples, trace.values, trace.weights
    assert samples is not None
    assert weight is not None
    assert values is not None
    assert values.radiance is not None
    alpha, reached = alphas_from_weights(weight)
    rgb, counted = values.radiance, values.radiance.any(dim=1)
    if not bool(counted.all()) and Quantity.RADIANCE in field.provides:
        queried = field.query(samples, Quantity.RADIANCE).radiance
        assert queried is not None
        rgb, counted = torch.where(counted[:, None], rgb, queried), counted | ~queried.any(dim=1)
    ends = torch.stack([samples.t0, samples.t1], dim=1).flatten()
    light = torch.stack([reached[:-1], reached[1:]], dim=1).flatten()
    levels = [(level.samples, level.weights) for level in trace.levels]
    return Contributions(
        kind="samples",
        t=samples.mid,
        begin=samples.t0,
        end=samples.t1,
        alpha=alpha,
        transmittance=reached[:-1],
        weight=weight,
        rgb=rgb,
        counted=counted,
        density=values.density,
        profile=_profile(field, ctx.bounds.clip(rays), ends, light, ctx),
        passes=tuple(Pass(s.t0, s.t1, w) for s, w in levels if s is not None and w is not None),
    )


def _profile(field: Field, rays: Rays, ends: Float[Tensor, " e"], reached: Float[Tensor, " e"], ctx: Context) -> Profile | None:
    """Density of the field from near to far, and transmittance: ``reached`` at interval ``ends``, interpolated in between."""
    near, far = (to_spacing(limit, ctx.bounds) for limit in (rays.near, rays.far))
    if not bool(rays.far > rays.near):
        return None
    even = from_spacing(torch.lerp(near, far, torch.linspace(0, 1, POINTS).to(near)), ctx.bounds)
    t = torch.cat([even, ends]).sort().values
    density = None
    if Quantity.DENSITY in field.provides:
        index = torch.zeros(len(t), dtype=torch.long, device=t.device)
        density = field.query(Samples.on(rays, index, t, t), Quantity.DENSITY).density
    if not len(ends):
        return Profile(t, density, torch.ones_like(t))
    # Within an interval of constant density, light falls exponentially: straight in its logarithm.
    after = torch.searchsorted(ends.contiguous(), t, right=True).clamp(1, len(ends) - 1)
    part = ((t - ends[after - 1]) / (ends[after] - ends[after - 1]).clamp_min(1e-12)).clamp(0, 1)
    logs = reached.clamp_min(1e-9).log()
    return Profile(t, density, torch.lerp(logs[after - 1], logs[after], part).exp())
