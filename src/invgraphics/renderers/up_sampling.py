"""Up-sampling along rays near the surface of a signed distance, at fixed sharpnesses (NeuS, Wang et al. 2021, §3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad
from typing_extensions import override

from invgraphics.core import Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.renderers.distance_density import section_optical_depth
from invgraphics.renderers.samplers import PADDING, check_samples, hit_indices, invert, pack, quantiles, strata, unit_ball_exit

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

    def build(self, scene: Scene) -> UpSampling:
        """The sampler; it needs nothing from the scene."""
        return UpSampling(self)


class UpSampling(Sampler):
    """Adds edges of intervals where weights, of distances taken as linear in between, say that a surface is."""

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
        knee = unit_ball_exit(rays[hit], ctx.bounds)
        edges = from_spacing(strata(rays[hit], self.config.coarse, ctx, knee), ctx.bounds, knee)
        with torch.no_grad():
            sdf = distances(field, rays, hit, edges)
            sharpness, levels = self.config.sharpness / ctx.bounds.half.mean(), []
            for number in range(self.config.rounds):
                weights = section_weights(edges, sdf, sharpness * 2**number)
                levels.append(Trace(pack(rays, hit, edges), None, weights.flatten(), rays=len(rays)))
                added = self._draw(edges, weights, (ctx, knee))
                merged, order = torch.cat([edges, added], dim=1).sort(dim=1)
                if number + 1 < self.config.rounds:
                    sdf = torch.cat([sdf, distances(field, rays, hit, added)], dim=1).gather(1, order)
                edges = merged
        return pack(rays, hit, edges), () if ctx.training else tuple(levels)

    def _draw(self, edges: Tensor, weights: Tensor, place: tuple[Context, Tensor]) -> Float[Tensor, "k added"]:
        ctx, knee = place
        spacing = to_spacing(edges, ctx.bounds, knee)
        u = quantiles(len(edges), self.config.fine // self.config.rounds, ctx, like=edges)
        return from_spacing(invert(spacing, weights + PADDING, u), ctx.bounds, knee)


def distances(field: Field, rays: Rays, hit: Int[Tensor, " k"], t: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
    """Signed distances at distances ``t`` along the rays ``hit``, outside the graph."""
    ray, flat = hit.repeat_interleave(t.shape[1]), t.reshape(-1)
    sdf = field.query_no_grad(Samples.on(rays, ray, flat, flat), Quantity.SDF).sdf
    assert sdf is not None
    return sdf.view_as(t)


def section_weights(
    edges: Float[Tensor, "k edges"], sdf: Float[Tensor, "k edges"], sharpness: Float[Tensor, ""]
) -> Float[Tensor, "k bins"]:
    """Weights of the intervals between edges, whose distances are linear in between, by NeuS's density.

    An interval falls no faster than the one before it, so that the near side of a thin thing is not taken for deep inside.
    """
    delta = edges.diff(dim=1)
    slope = sdf.diff(dim=1) / delta.clamp_min(torch.finfo(delta.dtype).tiny)
    slope = torch.minimum(slope, pad(slope[:, :-1], (1, 0))).clamp(-1, 0)
    depth = section_optical_depth((sdf[:, 1:] + sdf[:, :-1]) / 2, slope, delta, sharpness)
    return interval_weights(depth)


def depth_before(depth: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Optical depth before each of a ray's consecutive intervals."""
    return pad(depth[:, :-1].cumsum(dim=1), (1, 0))


def interval_weights(depth: Float[Tensor, "k bins"]) -> Float[Tensor, "k bins"]:
    """Weights of a ray's consecutive intervals from their optical depths (NeRF, equation 3)."""
    return torch.exp(-depth_before(depth)) * -torch.expm1(-depth)
