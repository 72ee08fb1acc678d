"""Up-sampling along rays near the surface of a signed distance, at fixed sharpnesses (NeuS, Wang et al. 2021, §3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad
from typing_extensions import override

from invgraphics.core import Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.compositing import weights_from_optical_depth
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.renderers.distance_density import section_optical_depth
from invgraphics.renderers.samplers import (
    PADDING,
    check_samples,
    hit_indices,
    pack_intervals,
    quantiles,
    sample_pdf,
    stratified_edges,
    unit_ball_exit,
)

MAX_ROUNDS = 64
"""Rounds of up-sampling; the sharpness doubles with each, and ends far beyond float32's resolution of a box."""


@dataclass(frozen=True)
class UpSamplingConfig:
    """Settings of NeuS's hierarchical sampling.

    Attributes:
        coarse: strata of the first pass.
        fine: samples added in all.
        rounds: in how many rounds they are added.
        sharpness: s of the first round's weights, per half-extent of the box; it doubles from round to round.
    """

    coarse: int = 64
    fine: int = 64
    rounds: int = 4
    sharpness: float = 64.0

    def __post_init__(self) -> None:
        check_samples(coarse=self.coarse, fine=self.fine)
        if not 1 <= self.rounds <= MAX_ROUNDS or self.fine % self.rounds:
            raise ValueError(f"rounds must be from 1 to {MAX_ROUNDS}, and fine a multiple of rounds.")
        if self.sharpness <= 0:
            raise ValueError(f"sharpness must be above 0, not {self.sharpness}")

    @property
    def samples_per_ray(self) -> int:
        """Samples on each ray."""
        return self.coarse + self.fine

    def build(self, scene: Scene) -> UpSampler:
        """The sampler; it needs nothing from the scene."""
        return UpSampler(self)


class UpSampler(Sampler):
    """NeuS's up-sampling: inserts edges where section weights of a piecewise linear signed distance are large."""

    def __init__(self, config: UpSamplingConfig) -> None:
        super().__init__()
        self.config = config

    @property
    @override
    def requires(self) -> Quantity:
        return Quantity.SDF

    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample every ray that meets the bounds; outside training the rounds' weights are returned as well."""
        hit = hit_indices(rays)
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        edges = from_spacing(stratified_edges(rays[hit], self.config.coarse, ctx, transition), ctx.bounds, transition)
        with torch.no_grad():
            sdf = signed_distances(field, rays, hit, edges)
            sharpness, levels = self.config.sharpness / ctx.bounds.half.mean(), []
            for number in range(self.config.rounds):
                weights = section_weights(edges, sdf, sharpness * 2**number)
                levels.append(Trace(pack_intervals(rays, hit, edges), None, weights.flatten(), rays=len(rays)))
                added = self._draw(edges, weights, transition, ctx)
                merged, order = torch.cat([edges, added], dim=1).sort(dim=1)
                if number + 1 < self.config.rounds:
                    sdf = torch.cat([sdf, signed_distances(field, rays, hit, added)], dim=1).gather(1, order)
                edges = merged
        return pack_intervals(rays, hit, edges), () if ctx.training else tuple(levels)

    def _draw(
        self, edges: Float[Tensor, "k edges"], weights: Float[Tensor, "k bins"], transition: Float[Tensor, "k 1"], ctx: Context
    ) -> Float[Tensor, "k added"]:
        """New edges of one round, drawn from ``weights`` in spacing coordinates."""
        spacing = to_spacing(edges, ctx.bounds, transition)
        u = quantiles(len(edges), self.config.fine // self.config.rounds, ctx, like=edges)
        return from_spacing(sample_pdf(spacing, weights + PADDING, u), ctx.bounds, transition)


def signed_distances(field: Field, rays: Rays, hit: Int[Tensor, " k"], t: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
    """Signed distances at distances ``t`` along the rays ``hit``, without gradients."""
    ray, flat = hit.repeat_interleave(t.shape[1]), t.reshape(-1)
    sdf = field.query_no_grad(Samples.on(rays, ray, flat, flat), Quantity.SDF).sdf
    assert sdf is not None
    return sdf.view_as(t)


def section_weights(
    edges: Float[Tensor, "k edges"], sdf: Float[Tensor, "k edges"], sharpness: Float[Tensor, ""]
) -> Float[Tensor, "k bins"]:
    """Weights of the intervals between edges by NeuS's density, with the signed distance assumed linear in each.

    No interval's slope exceeds that of the interval before it (NeuS): one that spans a thin object, behind which the distance
    rises again, keeps a falling slope.
    """
    delta = edges.diff(dim=1)
    slope = sdf.diff(dim=1) / delta.clamp_min(torch.finfo(delta.dtype).tiny)
    slope = torch.minimum(slope, pad(slope[:, :-1], (1, 0))).clamp(-1, 0)
    optical_depth = section_optical_depth((sdf[:, 1:] + sdf[:, :-1]) / 2, slope, delta, sharpness)
    return weights_from_optical_depth(optical_depth)
