"""What a renderer adds up along one pixel's ray, renderer by renderer in one form, so that it can be shown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core import (
    Camera,
    Context,
    Field,
    Gaussians,
    Quantity,
    RayRenderer,
    Rays,
    Renderer,
    Samples,
    Trace,
    no_grad_density,
)
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.kernels.reference.splat_raster import blending_weights, responses_at, visible_alphas
from invgraphics.renderers.gaussian_quadrature import phi
from invgraphics.renderers.gaussian_rays import colours, encounter, prepare
from invgraphics.renderers.gaussian_volume import GaussianExact, GaussianSorted
from invgraphics.renderers.samplers import Hierarchical, from_spacing, to_spacing
from invgraphics.renderers.splatting import Splatting

Kind = Literal["samples", "splats", "gaussians"]
"""What is added up: intervals of a field; splats in the order of the picture; Gaussians met along the ray."""
POINTS = 512
"""Points of a profile."""
DARK = 1e-6
"""Transmittance below which nothing can be said about the opacity of what lies there: it is lost in rounding."""
REACH = 4.0
"""Standard deviations to either side of the first and last Gaussian that a profile covers."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The light of a ray at p distances, increasing.

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
        kind: what they are.
        t: distance along the ray: the interval's middle, or the largest response of a Gaussian.
        begin: where the interval begins; for Gaussians, one standard deviation nearer.
        end: where it ends; for Gaussians, one standard deviation farther.
        alpha: opacity of each by itself.
        transmittance: share of its light that the others let through.
        weight: share of the pixel's light; ``transmittance * alpha`` unless they overlap.
        rgb: colours in the scene's colour space.
        counted: whether the renderer asked for the colour; what weighs next to nothing is left out of its sum.
        density: at the samples, per local unit.
        profile: density and transmittance in between.
        marched: for splats: the same Gaussians as overlapping densities, each with the optical depth of its alpha.
        passes: earlier passes of a sampler, first to last.
    """

    kind: Kind
    t: Float[Tensor, " k"]
    begin: Float[Tensor, " k"]
    end: Float[Tensor, " k"]
    alpha: Float[Tensor, " k"]
    transmittance: Float[Tensor, " k"]
    weight: Float[Tensor, " k"]
    rgb: Float[Tensor, "k 3"]
    counted: Bool[Tensor, " k"]
    density: Float[Tensor, " k"] | None = None
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
        """Mean distance of the light, Σ w t / Σ w; infinite where there is none."""
        return float((self.weight * self.t).sum()) / self.opacity if self.opacity > 0 else math.inf

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


@torch.no_grad()
def along_ray(field: Field, renderer: Renderer, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
    """Everything that makes up one pixel, as evaluation renders it.

    Args:
        field: a fitted field.
        renderer: what renders it.
        camera: whose pixel.
        pixel: column and row, from 0.
        ctx: as in evaluation, so without randomness.

    Raises:
        InputError: the renderer composites nothing along rays that could be shown.
    """
    point = camera.focal.new_tensor([[pixel[0] + 0.5, pixel[1] + 0.5]])
    rays = camera.rays(point)
    if isinstance(renderer, Splatting):
        return _splats(field.primitives(Quantity.GAUSSIANS, ctx), renderer, camera, point)
    if isinstance(renderer, GaussianExact | GaussianSorted):
        rays = rays.within(rays.near.clamp_min(ctx.bounds.near), rays.far)
        return _gaussians(field.primitives(Quantity.GAUSSIANS, ctx), renderer, camera, rays)
    if isinstance(renderer, RayRenderer):
        _, trace = renderer.render_rays(field, rays, ctx)
        if trace.samples is not None and trace.weights is not None:
            return _samples(field, renderer, trace, rays, ctx)
    raise InputError(f"{type(renderer).__name__} keeps no samples along rays that could be explained.")


def _samples(field: Field, renderer: RayRenderer, trace: Trace, rays: Rays, ctx: Context) -> Contributions:
    """Intervals of a field, and its density in between."""
    samples, values, weight = trace.samples, trace.values, trace.weights
    assert samples is not None
    assert weight is not None
    assert values is not None
    assert values.radiance is not None
    alpha, reached = _alphas(weight)
    rgb, counted = values.radiance, values.radiance.any(dim=1)
    if not bool(counted.all()):
        asked = field.query(samples, Quantity.RADIANCE).radiance
        assert asked is not None
        rgb, counted = torch.where(counted[:, None], rgb, asked), counted | ~asked.any(dim=1)
    ends = torch.stack([samples.t0, samples.t1], dim=1).flatten()
    light = torch.stack([reached[:-1], reached[1:]], dim=1).flatten()
    clipped = ctx.bounds.clip(rays)
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
        profile=_field_profile(field, clipped, (ends, light), ctx),
        passes=_passes(field, renderer, trace, clipped, ctx),
    )


def _alphas(weight: Float[Tensor, " k"]) -> tuple[Float[Tensor, " k"], Float[Tensor, " k_plus_1"]]:
    """From weights back to opacities, whatever the renderer made them of; and the light left before each and at the end."""
    reached = 1 - torch.nn.functional.pad(weight.double().cumsum(0), (1, 0))
    alpha = (weight / reached[:-1].clamp_min(DARK)).clamp(0, 1)
    return alpha.to(weight.dtype), reached.clamp(0, 1).to(weight.dtype)


def _field_profile(field: Field, rays: Rays, light: tuple[Tensor, Tensor], ctx: Context) -> Profile | None:
    """The field's own density from near to far, and what its samples (interval ends, transmittance there) let through."""
    near, far = (to_spacing(limit, ctx.bounds) for limit in (rays.near, rays.far))
    if not bool(rays.far > rays.near):
        return None
    ends, reached = light
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


def _passes(field: Field, renderer: RayRenderer, trace: Trace, rays: Rays, ctx: Context) -> tuple[Pass, ...]:
    """Earlier passes; one that a sampler made with the field's own density is made again, because no trace keeps it."""
    levels = trace.levels
    sampler = getattr(renderer, "sampler", None)
    if not levels and isinstance(sampler, Hierarchical):
        levels = (sampler.first_pass(rays, no_grad_density(field), ctx)[1],)
    found = [(level.samples, level.weights) for level in levels]
    return tuple(Pass(s.t0, s.t1, w) for s, w in found if s is not None and w is not None)


def _splats(gaussians: Gaussians, renderer: Splatting, camera: Camera, point: Float[Tensor, "1 2"]) -> Contributions:
    """The splats whose footprints cover the pixel, by the depth of their centres."""
    footprints, rgb = renderer.project(gaussians, camera)
    seen = (footprints.radii > 0).nonzero()[:, 0]
    order = seen[footprints.depths[seen].argsort(stable=True)]
    alpha = visible_alphas(responses_at(footprints, order, point))[0]
    order, alpha = order[alpha > 0], alpha[alpha > 0]
    weight = blending_weights(alpha[None])[0]
    drawn = int((weight > 0).sum())  # the renderer stops when next to no light is left
    order, alpha, weight = order[:drawn], alpha[:drawn], weight[:drawn]
    clear = torch.cumprod(torch.nn.functional.pad(1 - alpha, (1, 0), value=1.0), dim=0)[:-1]
    planes = footprints.depth_planes[order]
    t = planes[:, 0] + ((point - footprints.means2d[order]) * planes[:, 1:]).sum(dim=1)
    rays = camera.rays(point)
    # Along the ray a Gaussian's standard deviation is 1 / |diag(1/s) Rᵀ d|; a disc has none.
    axes = quaternion_to_matrix(gaussians.quaternions[order])
    sigma = ((rays.directions[0] @ axes) / gaussians.scales[order]).norm(dim=1).reciprocal()
    if renderer.config.shape == "disc":
        sigma = torch.zeros_like(sigma)
    marched = _marched(t, sigma, -torch.log1p(-alpha), rays)
    every = torch.ones_like(order, dtype=torch.bool)
    return Contributions("splats", t, t - sigma, t + sigma, alpha, clear, weight, rgb[order], every, marched=marched)


def _gaussians(gaussians: Gaussians, renderer: GaussianExact | GaussianSorted, camera: Camera, rays: Rays) -> Contributions:
    """Gaussians met along the ray, nearest first, or in the order in which a sorting renderer composites them."""
    primitives = prepare(gaussians, renderer.config.opacity, renderer.config.smallest, camera.position)
    met = encounter(primitives, rays)
    axis = camera.cam_to_world[:3, 2]
    weight, _ = renderer.weigh(met, rays, axis, False)
    order = renderer.order(met, rays, axis) if isinstance(renderer, GaussianSorted) else met.t.argsort(stable=True)
    order = order[met.depth[order] > 0]  # what splatters do not see is on the ray all the same
    t, sigma, depth, weight = (values[order] for values in (met.t, met.sigma, met.depth, weight))
    rgb, every = colours(primitives, met)[order], torch.ones_like(order, dtype=torch.bool)
    marched, profile = _marched(t, sigma, depth, rays), None
    if isinstance(renderer, GaussianSorted):
        alpha, reached = _alphas(weight)
        clear = reached[:-1]
    else:
        alpha, clear = -torch.expm1(-depth), _light(t, t, sigma, depth, rays)
        profile, marched = marched, None
    sides = t - sigma, t + sigma
    return Contributions("gaussians", t, *sides, alpha, clear, weight, rgb, every, profile=profile, marched=marched)


def _marched(t: Float[Tensor, " k"], sigma: Float[Tensor, " k"], depth: Float[Tensor, " k"], rays: Rays) -> Profile | None:
    """Gaussians of given optical depths as one density along the ray."""
    if not len(t) or not bool((sigma > 0).all()):
        return None
    low, high = (t - REACH * sigma).amin().maximum(rays.near[0]), (t + REACH * sigma).amax()
    # Evenly, and closely around every centre, since some are much thinner than others.
    even = torch.lerp(low, high, torch.linspace(0, 1, POINTS).to(t))
    close = (t[:, None] + sigma[:, None] * torch.linspace(-3, 3, 13).to(t)).flatten()
    at = torch.cat([even, close.clamp(low, high)]).sort().values
    bells = torch.exp(-0.5 * ((at[:, None] - t) / sigma).square()) / math.sqrt(2 * math.pi)
    return Profile(at, (bells * (depth / sigma)).sum(dim=1), _light(at, t, sigma, depth, rays))


def _light(at: Tensor, t: Float[Tensor, " k"], sigma: Float[Tensor, " k"], depth: Float[Tensor, " k"], rays: Rays) -> Tensor:
    """Transmittance at distances ``at`` through Gaussians of given optical depths."""
    passed = phi((at[:, None] - t) / sigma) - phi((rays.near[0] - t) / sigma)
    return torch.exp(-(passed * depth).sum(dim=1))
