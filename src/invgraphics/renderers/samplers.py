"""Stateless samplers: stratified along each ray, and hierarchical by importance sampling of a coarse pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import Bounds, Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.errors import NotComposableError
from invgraphics.renderers.quadrature import sample_weights

PADDING = 1e-5
"""Added to every coarse weight so that no part of a ray is ruled out (NeRF, reference code)."""


MAX_SAMPLES = 1 << 16
"""Samples of a ray; float32 barely separates more."""


def check_samples(**counts: int) -> None:
    """Check numbers of samples on a ray, by their names.

    Raises:
        ValueError: one is below 1 or above `MAX_SAMPLES`.
    """
    for name, count in counts.items():
        if not 1 <= count <= MAX_SAMPLES:
            raise ValueError(f"{name} must be from 1 to {MAX_SAMPLES}, not {count}")


@dataclass(frozen=True)
class StratifiedConfig:
    """Settings of stratified sampling: equal strata along each ray.

    Attributes:
        count: samples per ray.
    """

    count: int = 64

    def __post_init__(self) -> None:
        check_samples(count=self.count)

    @property
    def samples_per_ray(self) -> int:
        """Samples on each ray."""
        return self.count

    def build(self, scene: Scene) -> StratifiedSampler:
        """The sampler; it needs nothing from the scene."""
        return StratifiedSampler(self)


class StratifiedSampler(Sampler):
    """Stratified sampler: intervals tile each ray from near to far, inner edges jittered in training."""

    def __init__(self, config: StratifiedConfig) -> None:
        super().__init__()
        self.config = config

    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample every ray that intersects the bounds, without querying the field."""
        hit = hit_indices(rays)
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        edges = from_spacing(stratified_edges(rays[hit], self.config.count, ctx, transition), ctx.bounds, transition)
        return pack_intervals(rays, hit, edges), ()


@dataclass(frozen=True)
class HierarchicalConfig:
    """Settings of hierarchical sampling: coarse strata, fine samples drawn from the coarse weights (NeRF, §5.2).

    Attributes:
        coarse: strata of the first pass.
        fine: samples added by the second pass.
        proposal: a field of its own for the first pass, trained through ``Trace.levels``; ``None`` takes the
            rendered field's density, without a gradient.
    """

    coarse: int = 64
    fine: int = 64
    proposal: Annotated[Any, Slot("fields")] | None = None

    def __post_init__(self) -> None:
        check_samples(coarse=self.coarse, fine=self.fine)

    @property
    def samples_per_ray(self) -> int:
        """Samples on each ray."""
        return self.coarse + self.fine

    def build(self, scene: Scene) -> HierarchicalSampler:
        """The sampler, with its proposal field if it has one."""
        return HierarchicalSampler(self, None if self.proposal is None else self.proposal.build(scene))


class HierarchicalSampler(Sampler):
    """Hierarchical sampler: two passes, whose merged edges bound the second pass's intervals."""

    def __init__(self, config: HierarchicalConfig, proposal: Field | None = None) -> None:
        super().__init__()
        if proposal is not None and Quantity.DENSITY not in proposal.provides:
            raise NotComposableError(f"A proposal needs density, which {type(proposal).__name__} does not provide.")
        self.config = config
        self.proposal = proposal

    @override
    def untrained(self) -> HierarchicalSampler:
        """Copy of the sampler with the rendered field's density in place of a trained proposal, as in NeRF."""
        return self if self.proposal is None else HierarchicalSampler(replace(self.config, proposal=None))

    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample by two passes; returns the first pass's trace too, in training only if its proposal field is trained."""
        hit = hit_indices(rays)
        spacing, trace = self._coarse_pass(rays, field, ctx)
        assert trace.weights is not None
        with torch.no_grad():
            weights = trace.weights.reshape(len(hit), self.config.coarse)
            drawn = sample_pdf(spacing, weights + PADDING, quantiles(len(hit), self.config.fine, ctx, like=spacing))
        both = torch.cat([spacing, drawn], dim=1).sort(dim=1).values
        edges = from_spacing(both, ctx.bounds, unit_ball_exit(rays[hit], ctx.bounds))
        hidden = ctx.training and self.proposal is None
        return pack_intervals(rays, hit, edges), () if hidden else (trace,)

    def _coarse_pass(self, rays: Rays, field: Field, ctx: Context) -> tuple[Float[Tensor, "k edges"], Trace]:
        """Edges of the coarse strata in spacing coordinates, for the rays that meet the bounds, and their weights."""
        hit = hit_indices(rays)
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        spacing = stratified_edges(rays[hit], self.config.coarse, ctx, transition)
        coarse = pack_intervals(rays, hit, from_spacing(spacing, ctx.bounds, transition))
        if self.proposal is None:
            values, sigma = None, field.density_no_grad(coarse)
        else:
            values = self.proposal.query(coarse, self.proposal.provides & (Quantity.DENSITY | Quantity.RADIANCE))
            assert values.density is not None
            sigma = values.density
        return spacing, Trace(coarse, values, sample_weights(sigma, coarse, len(rays)), rays=len(rays))


def hit_indices(rays: Rays) -> Int[Tensor, " k"]:
    """Indices of the rays that hit the bounds: far > near."""
    return torch.nonzero(rays.far > rays.near)[:, 0]


def unit_ball_exit(rays: Rays, bounds: Bounds) -> Float[Tensor, "k 1"]:
    """Distance by which a ray has left the bounds' unit ball, from any origin: the ``transition`` of `to_spacing`."""
    return (rays.origins - bounds.centre).norm(dim=1, keepdim=True) + bounds.half.max()


def stratified_edges(
    rays: Rays, count: int, ctx: Context, transition: Float[Tensor, "k 1"] | None = None
) -> Float[Tensor, "k edges"]:
    """``count + 1`` edges from near to far in spacing coordinates; in training the inner ones move by up to half a stratum.

    Fields are queried halfway between two edges, which is denser in the middle of a stratum than at its ends; NeRF's points
    (equation 2) are uniform in it.
    """
    of_ray = None if transition is None else transition[:, 0]
    near, far = to_spacing(rays.near, ctx.bounds, of_ray), to_spacing(rays.far, ctx.bounds, of_ray)
    fraction = torch.arange(count + 1, dtype=near.dtype, device=near.device).expand(len(near), -1)
    if ctx.training and count > 1:
        shift = ctx.rand((len(near), count - 1), like=near) - 0.5
        fraction = fraction + torch.nn.functional.pad(shift, (1, 1))
    return torch.lerp(near[:, None], far[:, None], fraction / count)


def quantiles(rays: int, count: int, ctx: Context, like: Tensor, *, per_ray: bool = False) -> Float[Tensor, "k count"]:
    """Stratified quantiles: one in each of ``count`` equal parts of [0, 1], the middle, or random in training.

    With ``per_ray`` all of a ray's are at the same place in their parts.
    """
    shape = (rays, 1 if per_ray else count)
    within = ctx.rand(shape, like=like) if ctx.training else like.new_full(shape, 0.5)
    return (torch.arange(count, dtype=like.dtype, device=like.device) + within) / count


def sample_pdf(
    edges: Float[Tensor, "k bins_plus_1"], weights: Float[Tensor, "k bins"], u: Float[Tensor, "k c"]
) -> Float[Tensor, "k c"]:
    """Sample a piecewise constant density at quantiles ``u`` by inverting its CDF (NeRF's ``sample_pdf``).

    Args:
        edges: bin edges, increasing.
        weights: unnormalised probability of each bin, >= 0, and > 0 for some of each row.
        u: quantiles in [0, 1].
    """
    cumulative = torch.nn.functional.pad((weights / weights.sum(dim=1, keepdim=True)).cumsum(dim=1), (1, 0))
    upper = torch.searchsorted(cumulative, u.contiguous(), right=True).clamp(1, weights.shape[1])
    c0, c1 = cumulative.gather(1, upper - 1), cumulative.gather(1, upper)
    e0, e1 = edges.gather(1, upper - 1), edges.gather(1, upper)
    # A bin without weight is met only by a quantile that was rounded to 1.
    return torch.lerp(e0, e1, ((u - c0) / (c1 - c0).clamp_min(torch.finfo(c0.dtype).tiny)).clamp(0, 1))


def pack_intervals(rays: Rays, hit: Int[Tensor, " k"], edges: Float[Tensor, "k edges"]) -> Samples:
    """Pack the intervals between ``edges`` of the rays ``hit`` into samples."""
    ray = hit.repeat_interleave(edges.shape[1] - 1)
    return Samples.on(rays, ray, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1))
