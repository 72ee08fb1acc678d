"""Sphere tracing of a signed distance: one surface point per ray, differentiated by the implicit function theorem."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core import (
    Bounds,
    Camera,
    Context,
    Contributions,
    Field,
    Quantity,
    RayRenderer,
    Rays,
    Rendering,
    Samples,
    Scene,
    SurfaceTrace,
    Trace,
)
from invgraphics.core.ngp import FusedSDF
from invgraphics.kernels.reference.tracing import sphere_trace
from invgraphics.kernels.types import TracedRays, TracingLimits
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.volumetric import query

MAX_LOOKUPS = 1 << 16
"""Look-ups of a ray, far more than any needs."""
SATURATION = 8.0
"""Logit of opacity beyond which a ray counts as opaque, or as empty: the sigmoid is 3e-4 from 1, or from 0."""
MIN_SLOPE = 0.05
"""Least slope of the distance along a ray at its hit, over the gradient's length: hits of grazing rays move infinitely fast."""


CELLS_PER_RAY = 0.25
"""Cells of a picture's grid of distances per ray: each costs a look-up, and spares rays one to three and a half.

From 0.1 to 0.5 it hardly matters: five fits on four scenes at 200, 400 and 800 pixels.
"""
SKIPPED_SHARE = 0.8
"""Share of a cell's distance that rays skip: fitted distances may grow faster than the way.

With 1, up to 0.2 % of a picture's pixels change that do not with 0.8, for the worst of 17 fits (VolSDF on `materials`), and
look-ups fall by 3 to 7 % (three fits).
"""


@dataclass(frozen=True)
class SphereTracingConfig:
    """Rendering of a signed distance's surface, with silhouettes that are soft on the outside and inside.

    Attributes:
        steps: most look-ups of a ray before refinement.
        relaxation: factor of each step over the signed distance (Keinert et al. 2014: 1.2 to 1.8; 1 is Hart's); below 1 for
            distances that grow faster than the way.
        refinements: most look-ups of a ray in the bracket of its hit, or of its closest approach.
        least_step: shortest step, in mean half-extents of the box.
        tolerance: signed distance up to which a hit is refined, in mean half-extents of the box.
        sharpness: of the silhouettes' sigmoid at the fit's start, per mean half-extent of the box (IDR: 50).
        final_sharpness: the same at its end and for pictures, approached exponentially (IDR: 1600).
        sharp_at: progress at which that is reached.
    """

    title: ClassVar[str] = "sphere tracing"

    steps: int = 64
    relaxation: float = 1.2
    refinements: int = 8
    least_step: float = 1e-4
    tolerance: float = 1e-6
    sharpness: float = 50.0
    final_sharpness: float = 1600.0
    sharp_at: float = 1.0

    def __post_init__(self) -> None:
        if not (1 <= self.steps <= MAX_LOOKUPS and 0 <= self.refinements <= MAX_LOOKUPS):
            raise ValueError(f"'steps' must be from 1 to {MAX_LOOKUPS}, 'refinements' from 0 to that.")
        if not 0 < self.relaxation < 2:
            raise ValueError(f"'relaxation' must be in (0, 2), not {self.relaxation}.")
        if min(self.least_step, self.tolerance, self.sharpness, self.final_sharpness, self.sharp_at) <= 0:
            raise ValueError("'least_step', 'tolerance', 'sharpness', 'final_sharpness' and 'sharp_at' must be above 0.")

    def build(self, scene: Scene) -> SphereTracing:
        """The renderer; its lengths are those of ``scene``'s box."""
        return SphereTracing(self)

    def sharpness_at(self, progress: float) -> float:
        """Sharpness at a point of the fit, per mean half-extent."""
        return self.sharpness * (self.final_sharpness / self.sharpness) ** min(1.0, progress / self.sharp_at)


class SphereTracing(RayRenderer):
    """Sphere-tracing renderer: the colour at a ray's first hit, as opaque as its deepest point is deep.

    A ray that misses the surface shows the colour at its closest approach. Both are as opaque as ``sigmoid(-sharpness * f)``,
    where f is the least signed distance on the ray (IDR, Yariv et al. 2020, equation 7), so that pictures are continuous across
    silhouettes, and fits see surfaces grow and shrink. Silhouettes in front of other surfaces are hard, and have no gradient.
    """

    requires: ClassVar[Quantity] = Quantity.SDF | Quantity.GRADIENT | Quantity.RADIANCE

    def __init__(self, config: SphereTracingConfig) -> None:
        super().__init__()
        self.config = config

    def limits(self, ctx: Context) -> TracingLimits:
        """When rays stop, in local length units."""
        config, unit = self.config, float(ctx.bounds.half.mean())
        depth = SATURATION * unit / config.sharpness_at(ctx.progress)
        least, tolerance = config.least_step * unit, config.tolerance * unit
        return TracingLimits(config.steps, config.relaxation, config.refinements, least, tolerance, depth)

    @override
    def render_whole(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace] | None:
        """A picture outside the graph, by kernels where they support the field; rays begin where a grid says that they may."""
        fused = None if torch.is_grad_enabled() else _fused(field, ctx)
        if fused is None:
            return None
        unclipped, limits = camera.rays(), self.limits(ctx)
        rays = ctx.bounds.clip(unclipped)
        traced = kernels.sdf_trace(_skip_free_space(rays, ctx.bounds, fused, limits), ctx.bounds, fused, limits)
        rendering, trace = self._shade(field, rays, traced, limits, ctx, unclipped.far)
        return rendering.reshape(camera.height, camera.width), trace

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; with normals if ``ctx.geometry`` is set."""
        clipped, limits = ctx.bounds.clip(rays), self.limits(ctx)
        return self._shade(field, clipped, _trace(field, clipped, limits, ctx), limits, ctx, rays.far)

    def _shade(
        self, field: Field, rays: Rays, traced: TracedRays, limits: TracingLimits, ctx: Context, far: Float[Tensor, " n"]
    ) -> tuple[Rendering, Trace]:
        """Render n rays of which it is known where they meet the surface; those that meet none have the depth ``far``."""
        sharpness = SATURATION / limits.depth
        logit = -sharpness * _lowest(field, rays, traced, ctx)
        surface = SurfaceTrace(logit, sharpness, traced.hit, traced.steps, traced.converged)
        alpha = opacity(logit)
        seen = torch.nonzero(alpha.detach())[:, 0]
        t = _surface_distance(field, rays, traced, seen, ctx)
        samples = Samples.on(rays, seen, t, t)
        want = Quantity.RADIANCE | (Quantity.GRADIENT if ctx.geometry else Quantity.NONE)
        values = query(field, samples, want, ctx.chunk)
        trace = Trace(samples, values, alpha[seen], rays=len(rays), surface=surface)
        return _picture(rays, trace, alpha, far), trace

    @override
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """The one surface point of the pixel's ray, if any; see `Renderer.contributions`."""
        return replace(super().contributions(field, camera, pixel, ctx), kind="surface points")


def opacity(logit: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Sigmoid that reaches 0 and 1 at -`SATURATION` and `SATURATION`: rays end there, without their true least distance."""
    low, high = 1 / (1 + math.exp(SATURATION)), 1 / (1 + math.exp(-SATURATION))
    return (logit.clamp(-SATURATION, SATURATION).sigmoid() - low).clamp_min(0) / (high - low)


def _fused(field: Field, ctx: Context) -> FusedSDF | None:
    """Parameters of a field for compiled kernels; ``None`` where there are none."""
    if ctx.bounds.space != "box" or not kernels.compiled("sdf_trace", ctx.bounds.lo):
        return None
    return field.fused_sdf(ctx.bounds)


def _skip_free_space(rays: Rays, bounds: Bounds, fused: FusedSDF, limits: TracingLimits) -> Rays:
    """Rays that begin where a grid of distances first leaves a surface possible, and before silhouettes begin to show."""
    resolution = max(1, round((len(rays) * CELLS_PER_RAY) ** (1 / 3)))
    cells = [resolution] * 3
    distances = kernels.sdf_values(bounds.cell_centres(cells), bounds, fused).reshape(cells)
    least, factor = float(bounds.half.mean()) / (2 * resolution), SKIPPED_SHARE * min(1.0, limits.relaxation)
    return rays.within(kernels.sdf_skip(rays, bounds, distances, limits.depth, least, factor), rays.far)


def _trace(field: Field, rays: Rays, limits: TracingLimits, ctx: Context) -> TracedRays:
    """Trace rays through any field, in one compiled pass where a kernel supports it."""
    fused = _fused(field, ctx)
    if fused is not None:
        return kernels.sdf_trace(rays, ctx.bounds, fused, limits)

    def distance(index: Int[Tensor, " k"], t: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        return _sdf(field, Samples.on(rays, index, t, t), ctx)

    return sphere_trace(distance, rays, limits)


def _picture(rays: Rays, trace: Trace, alpha: Float[Tensor, " n"], far: Float[Tensor, " n"]) -> Rendering:
    """The rendering of rays with at most one surface point each."""
    samples, values, weights = trace.samples, trace.values, trace.weights
    assert samples is not None
    assert values is not None
    assert values.radiance is not None
    assert weights is not None

    def spread(value: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
        return value.new_zeros(len(rays), value.shape[1]).index_copy(0, samples.ray, weights[:, None] * value)

    distance = spread(samples.t0[:, None])[:, 0]
    normal = None if values.gradient is None else spread(normalize(values.gradient, dim=1))
    return to_rendering(spread(values.radiance), alpha, distance, normal, far, rays.directions)


def _lowest(field: Field, rays: Rays, traced: TracedRays, ctx: Context) -> Float[Tensor, " n"]:
    """Least signed distance on each ray, differentiable in field and rays: its distance t is stationary or an end."""
    if not torch.is_grad_enabled():
        return traced.low
    met = torch.nonzero(traced.low.isfinite())[:, 0]
    t = traced.low_t[met]
    return traced.low.index_copy(0, met, _sdf(field, Samples.on(rays, met, t, t), ctx))


def _surface_distance(
    field: Field, rays: Rays, traced: TracedRays, seen: Int[Tensor, " k"], ctx: Context
) -> Float[Tensor, " k"]:
    """Distance along the rays ``seen`` to their hits, or to their closest approaches.

    A hit follows field and ray by the implicit function theorem, ``t - (f(x) - f(x).detach()) / (n . d)`` with the gradient n
    of f (IDR, equation 3; Niemeyer et al. 2020): none goes through the march. Where a ray begins inside, its hit is fixed.
    """
    t = torch.where(traced.hit, traced.hit_t, traced.low_t)[seen]
    moving = torch.nonzero(traced.hit[seen] & (t > rays.near[seen]))[:, 0]
    if not torch.is_grad_enabled() or not len(moving):
        return t
    samples = Samples.on(rays, seen[moving], t[moving], t[moving])
    with torch.no_grad():
        gradient = query(field, samples, Quantity.GRADIENT, ctx.chunk).gradient
        assert gradient is not None
        slope = (gradient * samples.direction).sum(dim=1)
        slope = torch.minimum(slope, -MIN_SLOPE * gradient.norm(dim=1).clamp_min(MIN_SLOPE))
    value = _sdf(field, samples, ctx)
    return t.index_copy(0, moving, t[moving] - (value - value.detach()) / slope)


def _sdf(field: Field, samples: Samples, ctx: Context) -> Float[Tensor, " m"]:
    distance = query(field, samples, Quantity.SDF, ctx.chunk).sdf
    assert distance is not None
    return distance
