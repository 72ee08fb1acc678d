"""Sampling by proposals: small density fields that guide where samples are placed (mip-NeRF 360, Barron et al. 2022, §3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.errors import NotComposableError
from invgraphics.renderers.histograms import blur, dilate, resample
from invgraphics.renderers.quadrature import sample_weights
from invgraphics.renderers.samplers import hit_indices, pack_intervals, unit_ball_exit


@dataclass(frozen=True)
class ProposalsConfig:
    """Settings of sampling by proposals; the defaults are mip-NeRF 360's unless noted.

    Attributes:
        counts: intervals per ray of each proposal level.
        count: intervals per ray of the last level, which is rendered.
        fields: densities of the proposal levels, one for each or one for all (mip-NeRF 360), trained by the loss
            ``interlevel`` alone. None at all: each level queries the rendered field, as in NeRF and mip-NeRF.
        train_levels: whether levels that query the rendered field are rendered in colour in training, with gradients, for the
            loss ``coarse`` (mip-NeRF).
        dilation: widening of a level's intervals before the next one is drawn, in the longest interval of the spacing's [0, 1]
            over the product of the numbers of intervals so far; thin things then survive between two rays.
        dilation_bias: the same as a share of the ray.
        blurred: whether weights are widened by mip-NeRF's filter (equation 18) instead.
        padding: added to every weight before it is drawn from (mip-NeRF: 0.01; mip-NeRF 360: 0).
        anneal: slope s of the exponent s p / ((s - 1) p + 1) of weights at a progress p of the fit, which keeps samples
            spread out while proposals are untrained; 0 for none.
        anneal_until: progress of the fit at which the exponent has reached 1 (nerfacto: 1,000 of 30,000 steps).
        jitter_per_ray: whether all samples of a ray are moved together in training, and not one by one.
    """

    counts: tuple[int, ...] = (64, 64)
    count: int = 32
    fields: tuple[Annotated[Any, Slot("fields")], ...] = ()
    train_levels: bool = False
    dilation: float = 0.5
    dilation_bias: float = 0.0025
    blurred: bool = False
    padding: float = 1e-5
    anneal: float = 10.0
    anneal_until: float = 1.0
    jitter_per_ray: bool = True

    def __post_init__(self) -> None:
        if not self.counts or min(*self.counts, self.count) < 2:
            raise ValueError("counts must name one level at least, and every level needs 2 intervals or more.")
        if len(self.fields) not in (0, 1, len(self.counts)):
            raise ValueError(f"fields must be one for each of the {len(self.counts)} counts, one, or none: {len(self.fields)}.")
        if min(self.dilation, self.dilation_bias, self.anneal) < 0 or self.padding <= 0:
            raise ValueError("dilation, dilation_bias and anneal must not be negative, padding must be above 0.")
        if not 0 < self.anneal_until <= 1:
            raise ValueError(f"anneal_until must be above 0 and at most 1, not {self.anneal_until}.")
        if self.fields and self.train_levels:
            raise ValueError("train_levels is for levels without fields of their own.")
        if self.blurred and (self.dilation or self.dilation_bias):
            raise ValueError("weights are either blurred or dilated: blurred = true needs dilation = dilation_bias = 0.")

    def exponent(self, progress: float) -> float:
        """Exponent of weights at a progress of the fit in [0, 1], from 0 (even sampling) to 1."""
        passed = min(1.0, progress / self.anneal_until)
        return 1.0 if self.anneal == 0 else self.anneal * passed / ((self.anneal - 1) * passed + 1)

    def build(self, scene: Scene) -> ProposalSampler:
        """The sampler with the fields of its levels."""
        return ProposalSampler(self, [field.build(scene) for field in self.fields])


class ProposalSampler(Sampler):
    """Sampler of several levels, each drawn from the weights of the one before.

    Positions carry no gradient into levels with fields of their own: poses are fitted to the rendered level.

    Attributes:
        fields: densities of the proposal levels, or one for all; empty where the rendered field is queried.
    """

    def __init__(self, config: ProposalsConfig, fields: list[Field]) -> None:
        super().__init__()
        for field in fields:
            if Quantity.DENSITY not in field.provides:
                raise NotComposableError(f"A proposal needs density, which {type(field).__name__} does not provide.")
        self.config = config
        self.fields = nn.ModuleList(fields)

    @override
    def untrained(self) -> ProposalSampler:
        """Copy of the sampler with the rendered field's density in place of trained proposals."""
        if not self.config.fields:
            return self
        return ProposalSampler(replace(self.config, fields=()), [])

    @override
    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample every ray that meets the bounds, level by level; outside the graph the last level's density comes along."""
        hit = hit_indices(rays)
        near, far, transition = self._ends(rays, hit, ctx)
        edges, weights = near.new_tensor([0.0, 1.0]).expand(len(hit), 2), near.new_ones(len(hit), 1)
        exponent = self.config.exponent(ctx.progress if ctx.training else 1.0)
        levels: list[Trace] = []

        def at(edges: Float[Tensor, "k edges"]) -> Samples:
            return pack_intervals(rays, hit, from_spacing(torch.lerp(near, far, edges), ctx.bounds, transition))

        for index, count in enumerate(self.config.counts):
            edges = resample(edges, weights, count, ctx, per_ray=self.config.jitter_per_ray)
            level = self._level(index, at(edges), len(rays), field, ctx)
            levels.append(level)
            assert level.weights is not None
            level_weights = level.weights.detach().view(len(hit), count)
            edges, weights = self._widened(edges, level_weights, prod(self.config.counts[: index + 1]))
            # Dilation leaves intervals without length at a ray's ends: they are never drawn, whatever the exponent.
            weights = torch.where(edges.diff(dim=1) > 0, (weights + self.config.padding) ** exponent, 0.0)
        samples = at(resample(edges, weights, self.config.count, ctx, per_ray=self.config.jitter_per_ray))
        hidden = ctx.training and not self.config.fields and not self.config.train_levels
        return self._with_density(samples, field, ctx), () if hidden else tuple(levels)

    def _ends(self, rays: Rays, hit: Int[Tensor, " k"], ctx: Context) -> tuple[Tensor, Tensor, Tensor]:
        """Both ends of the rays in spacing coordinates, and the spacing's transition distance, each (k, 1)."""
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        near, far = (to_spacing(end[hit, None], ctx.bounds, transition) for end in (rays.near, rays.far))
        return near, far, transition

    @torch.no_grad()
    def _widened(
        self, edges: Float[Tensor, "k edges"], weights: Float[Tensor, "k bins"], intervals: int
    ) -> tuple[Tensor, Tensor]:
        """Edges and weights to draw from: dilated or blurred, where the settings say so."""
        if self.config.blurred:
            return edges, blur(weights)
        by = self.config.dilation_bias + self.config.dilation / intervals
        return dilate(edges, weights, by) if by > 0 else (edges, weights)

    def _level(self, index: int, samples: Samples, rays: int, field: Field, ctx: Context) -> Trace:
        """Density and weights of one level."""
        if self.config.fields:
            still = {name: getattr(samples, name).detach() for name in ("t0", "t1", "position", "direction")}
            samples = replace(samples, **still)
            values = self.fields[min(index, len(self.fields) - 1)].query(samples, Quantity.DENSITY)  # type: ignore[operator]
        elif self.config.train_levels and ctx.training:
            values = field.query(samples, Quantity.DENSITY | (field.provides & Quantity.RADIANCE))
        else:
            values = field.query_no_grad(samples, Quantity.DENSITY)
        assert values.density is not None
        return Trace(samples, values, sample_weights(values.density, samples, rays), rays=rays)

    def _with_density(self, samples: Samples, field: Field, ctx: Context) -> Samples:
        """Samples with the field's density and features, in inference, where renderers query radiance at few of them."""
        if ctx.training or torch.is_grad_enabled() or Quantity.DENSITY not in field.provides:
            return samples
        want = Quantity.DENSITY | (field.provides & Quantity.FEATURES)
        parts = [field.query_no_grad(samples[at : at + ctx.chunk], want) for at in range(0, len(samples), ctx.chunk)]
        if not parts:
            return samples
        density = torch.cat([part.density for part in parts if part.density is not None])
        features = [part.features for part in parts if part.features is not None]
        return replace(samples, density=density, features=torch.cat(features) if features else None)
