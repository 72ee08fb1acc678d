"""Sampling with a bound on the opacity's error (VolSDF, Yariv et al. 2021, §3.3 and 3.4, algorithm 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.compositing import optical_depth_before, weights_from_optical_depth
from invgraphics.core.spacing import from_spacing
from invgraphics.errors import NotComposableError
from invgraphics.renderers.distance_density import DistanceDensity, laplace_density
from invgraphics.renderers.samplers import (
    MAX_SAMPLES,
    PADDING,
    check_samples,
    hit_indices,
    pack_intervals,
    quantiles,
    sample_pdf,
    stratified_edges,
    unit_ball_exit,
)
from invgraphics.renderers.up_sampling import MAX_ROUNDS, signed_distances

LARGEST_ERROR = 1e6
"""Error bounds are clamped here: larger ones would overflow, and mean no more than "unbounded"."""


@dataclass(frozen=True)
class ErrorBoundedConfig:
    """Settings of algorithm 1; the defaults are the paper's.

    Attributes:
        coarse: strata of the first pass, and samples that a round adds.
        fine: samples drawn by the opacity of the last round.
        extra: samples taken from the edges of the last round.
        error: bound on the opacity's error, ε.
        rounds: most rounds.
        bisections: of the search for the least width that keeps the bound.
    """

    coarse: int = 128
    fine: int = 64
    extra: int = 32
    error: float = 0.1
    rounds: int = 5
    bisections: int = 10

    def __post_init__(self) -> None:
        check_samples(coarse=self.coarse, fine=self.fine)
        if not 0 <= self.extra <= MAX_SAMPLES:
            raise ValueError(f"extra must be from 0 to {MAX_SAMPLES}, not {self.extra}.")
        if not (1 <= self.rounds <= MAX_ROUNDS and 1 <= self.bisections <= MAX_ROUNDS):
            raise ValueError(f"rounds and bisections must be from 1 to {MAX_ROUNDS}.")
        if self.error <= 0:
            raise ValueError(f"error must be above 0, not {self.error}")

    @property
    def samples_per_ray(self) -> int:
        """Samples on each ray, those of the first pass included."""
        return self.coarse + self.fine + self.extra

    def build(self, scene: Scene) -> ErrorBoundedSampler:
        """The sampler; it needs nothing from the scene."""
        return ErrorBoundedSampler(self)


class ErrorBoundedSampler(Sampler):
    """VolSDF's sampler (algorithm 1): refine each ray until the opacity error is below ε.

    Where that fails within the rounds, samples follow the density of the smallest β for which the error is bounded.
    """

    def __init__(self, config: ErrorBoundedConfig) -> None:
        super().__init__()
        self.config = config

    @property
    @override
    def requires(self) -> Quantity:
        return Quantity.SDF

    @override
    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample every ray that meets the bounds.

        Raises:
            NotComposableError: the density is not derived from a signed distance, so it has no width.
        """
        if not isinstance(field, DistanceDensity):
            raise NotComposableError(
                f"error_bounded needs a density derived from a signed distance, not that of {type(field).__name__}.",
                "Use it with the renderers volsdf or neus.",
            )
        hit = hit_indices(rays)
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        spacing = stratified_edges(rays[hit], self.config.coarse, ctx, transition)
        edges = from_spacing(spacing, ctx.bounds, transition)
        with torch.no_grad():
            edges, sdf, beta = self._refined(edges, field, rays, hit, ctx)
            weights = weights_from_optical_depth(laplace_density(sdf[:, :-1], beta) * edges.diff(dim=1))
            drawn = sample_pdf(edges, weights + PADDING, quantiles(len(edges), self.config.fine, ctx, like=edges))
            merged = torch.cat([edges[:, :1], drawn, self._extra(edges, ctx), edges[:, -1:]], dim=1).sort(dim=1).values
        level = Trace(pack_intervals(rays, hit, edges), None, weights.flatten(), rays=len(rays))
        return pack_intervals(rays, hit, merged), () if ctx.training else (level,)

    def _refined(
        self, edges: Float[Tensor, "k edges"], field: DistanceDensity, rays: Rays, hit: Int[Tensor, " k"], ctx: Context
    ) -> tuple[Float[Tensor, "k more"], Float[Tensor, "k more"], Float[Tensor, "k 1"]]:
        """Edges refined in rounds where the error bound is large, their signed distances, and the least β of bounded error."""
        config, target = self.config, field.beta.detach()
        sdf = signed_distances(field, rays, hit, edges)
        # Large enough for any signed distances (lemma 2).
        beta = (edges.diff(dim=1).square().sum(dim=1, keepdim=True) / (4 * math.log1p(config.error))).sqrt().maximum(target)
        for number in range(config.rounds):
            delta = edges.diff(dim=1)
            clear = clear_distance(sdf, delta)
            beta = self._least_width(target, beta, delta, sdf, clear)
            if number + 1 == config.rounds or bool((beta <= target).all()):
                break
            weights = error_bounds(delta, sdf, clear, beta) + PADDING
            added = sample_pdf(edges, weights, quantiles(len(edges), config.coarse, ctx, like=edges))
            edges, order = torch.cat([edges, added], dim=1).sort(dim=1)
            sdf = torch.cat([sdf, signed_distances(field, rays, hit, added)], dim=1).gather(1, order)
        return edges, sdf, beta

    def _least_width(
        self,
        target: Float[Tensor, ""],
        beta: Float[Tensor, "k 1"],
        delta: Float[Tensor, "k bins"],
        sdf: Float[Tensor, "k edges"],
        clear: Float[Tensor, "k bins"],
    ) -> Float[Tensor, "k 1"]:
        """Width between ``target`` and ``beta`` at which the error is still bounded, by bisection."""

        def bounded(width: Tensor) -> Tensor:
            return error_bounds(delta, sdf, clear, width).amax(dim=1, keepdim=True) <= self.config.error

        low, high = target.expand_as(beta), beta
        for _ in range(self.config.bisections):
            middle = (low + high) / 2
            fits = bounded(middle)
            low, high = torch.where(fits, low, middle), torch.where(fits, middle, high)
        return torch.where(bounded(target.expand_as(beta)), target, high)

    def _extra(self, edges: Float[Tensor, "k edges"], ctx: Context) -> Float[Tensor, "k extra"]:
        """A subset of the edges, at the same indices on every ray; random in training."""
        count = min(self.config.extra, edges.shape[1])
        if not ctx.training:
            return edges[:, torch.linspace(0, edges.shape[1] - 1, count, device=edges.device).long()]
        order = ctx.rand((edges.shape[1],), like=edges).argsort()
        return edges[:, order[:count]]


def clear_distance(sdf: Float[Tensor, "k edges"], delta: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Lower bound of the distance to the surface along each interval, from that at its ends (equation 14, d*).

    No surface lies in the balls around both ends. Where they overlap, the bound is the height of the triangle of the two
    distances over the interval, or the smaller distance if the triangle is obtuse there; otherwise 0. It is 0, too, where the
    distance changes its sign, whose balls overlap only where it is none (a slope above 1).
    """
    a, b = sdf[:, :-1].abs(), sdf[:, 1:].abs()
    half = (a + b + delta) / 2
    area = (half * (half - a) * (half - b) * (half - delta)).clamp_min(0).sqrt()
    height = 2 * area / delta.clamp_min(torch.finfo(delta.dtype).tiny)
    obtuse = (a.square() - b.square()).abs() >= delta.square()
    apart = torch.where(obtuse, torch.minimum(a, b), torch.where(a + b > delta, height, 0.0))
    return torch.where(sdf[:, :-1] * sdf[:, 1:] > 0, apart, 0.0)


def error_bounds(
    delta: Float[Tensor, "k bins"], sdf: Float[Tensor, "k edges"], clear: Float[Tensor, "k bins"], beta: Float[Tensor, "k 1"]
) -> Float[Tensor, "k bins"]:
    """Bound on the error of the opacity that a left Riemann sum of Laplace's density has at each interval's end (equation 17).

    exp(-R) (exp(E) - 1) with the sum R before the interval, and the bound E = Σ δ² exp(-d* / β) / (4 β²) on its error
    (theorem 1).
    """
    error = (delta.square() * torch.exp(-clear / beta) / (4 * beta.square())).cumsum(dim=1)
    optical_depth = laplace_density(sdf[:, :-1], beta) * delta
    return torch.expm1(error.clamp_max(math.log(LARGEST_ERROR))) * torch.exp(-optical_depth_before(optical_depth))
