"""Learned aggregation by attention: a transformer over a ray's samples decides how much each contributes to the pixel.

After the ray transformers of IBRNet (Wang et al. 2021, arXiv 2102.13090, §3.2) and GNT (Varma et al. 2023, arXiv 2207.13298,
§3.3), on a field of features instead of features of nearby photographs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import (
    Context,
    Field,
    FieldValues,
    Quantity,
    RayRenderer,
    Rays,
    Rendering,
    Samples,
    Scene,
    Trace,
    harmonics,
)
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.ray_normals import normals_from_distances
from invgraphics.renderers.samplers import hit_indices, pack_intervals, stratified_edges, unit_ball_exit
from invgraphics.renderers.srn import pixel_network
from invgraphics.renderers.volumetric import query


@dataclass(frozen=True)
class RayAttentionConfig:
    """A transformer over the samples of a ray, read out by one query.

    Attributes:
        features: of the field.
        samples: per ray, stratified.
        blocks: transformer blocks over a ray's samples (GNT: 8).
        width: of a sample's token (GNT: 64).
        heads: of the blocks' attention (GNT: 4).
        octaves: of the encoding of a sample's place between the ray's ends.
        layers: hidden layers of the colour network.
        direction_degree: bands of the spherical harmonics through which it sees the direction, 1 to 4; 0 for none.
    """

    title: ClassVar[str] = "learned aggregation"

    features: int = 256
    samples: int = 64
    blocks: int = 2
    width: int = 64
    heads: int = 4
    octaves: int = 6
    layers: int = 1
    direction_degree: int = 3

    def __post_init__(self) -> None:
        if min(self.features, self.samples, self.width, self.heads) < 1 or min(self.blocks, self.octaves, self.layers) < 0:
            raise ValueError("features, samples, width and heads must be at least 1; blocks, octaves and layers at least 0.")
        if self.width % self.heads:
            raise ValueError(f"width ({self.width}) must be a multiple of heads ({self.heads}).")
        if not 0 <= self.direction_degree <= harmonics.MAX_DEGREE + 1:
            raise ValueError(f"direction_degree must be 0 to {harmonics.MAX_DEGREE + 1}, not {self.direction_degree}.")

    def build(self, scene: Scene) -> RayAttention:
        """The renderer, its weights drawn from torch's global generator."""
        return RayAttention(self)


class AttentionBlock(nn.Module):
    """Pre-normalised transformer block: self-attention, then a network of one hidden layer, each added to its input."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.net = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))

    def forward(self, tokens: Float[Tensor, "k s w"]) -> Float[Tensor, "k s w"]:
        """Tokens of k rays with s samples each."""
        x = self.norm(tokens)
        tokens = tokens + self.attention(x, x, x, need_weights=False)[0]
        return tokens + self.net(tokens)


class RayAttention(RayRenderer):
    """Renderer whose weights are a softmax over a ray's samples and a token for the background, which takes the rest.

    Attributes:
        embed: a sample's features and place to its token.
        blocks: transformer blocks over the tokens of a ray.
        query: token to its score under the pixel's query; weights are the softmax of a ray's scores and of `background`.
        background: score of the background.
        colour_net: token and direction to raw colour.
    """

    requires: ClassVar[Quantity] = Quantity.FEATURES

    def __init__(self, config: RayAttentionConfig) -> None:
        super().__init__()
        self.config = config
        self.embed = nn.Linear(config.features + 1 + 2 * config.octaves, config.width)
        self.blocks = nn.Sequential(*[AttentionBlock(config.width, config.heads) for _ in range(config.blocks)])
        self.norm = nn.LayerNorm(config.width)
        self.query = nn.Linear(config.width, 1)
        # An untrained ray is half opaque, however many samples it has.
        self.background = nn.Parameter(torch.tensor(math.log(config.samples)))
        self.colour_net = pixel_network(config.width + config.direction_degree**2, config.layers, config.width, 3)

    @property
    @override
    def feature_width(self) -> int:
        return self.config.features

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; with normals, from the mean distances of neighbouring rays, if ``ctx.geometry`` is set."""
        far, rays = rays.far, ctx.bounds.clip(rays)
        hit = hit_indices(rays)
        samples, tokens = self._tokens(field, rays, hit, ctx)
        weights = self.weights(tokens)
        radiance = self._radiance(tokens, rays.directions[hit]).flatten(0, 1)
        values = FieldValues(radiance=radiance)
        trace = Trace(samples, values, weights.flatten(), rays=len(rays))
        channels = torch.cat([radiance.unflatten(0, weights.shape), samples.mid.view(*weights.shape, 1)], dim=2)
        sums = torch.cat([(weights[..., None] * channels).sum(dim=1), weights.sum(dim=1, keepdim=True)], dim=1)
        sums = sums.new_zeros(len(rays), 5).index_copy(0, hit, sums)
        normal = None
        if ctx.geometry:
            normal = self._normals(field, rays, sums[:, 3] / sums[:, 4].clamp_min(1e-6), replace(ctx, training=False))
        return to_rendering(sums[:, :3], sums[:, 4], sums[:, 3], normal, far, rays.directions), trace

    def weights(self, tokens: Float[Tensor, "k s w"]) -> Float[Tensor, "k s"]:
        """Share of each sample in its ray's light; the sum over a ray is its opacity."""
        scores = self.query(tokens)[..., 0]
        return torch.cat([scores, self.background.expand(len(scores), 1)], dim=1).softmax(dim=1)[:, :-1]

    def _tokens(self, field: Field, rays: Rays, hit: Int[Tensor, " k"], ctx: Context) -> tuple[Samples, Float[Tensor, "k s w"]]:
        """Samples of the rays ``hit``, and their tokens after the transformer."""
        transition = unit_ball_exit(rays[hit], ctx.bounds)
        edges = stratified_edges(rays[hit], self.config.samples, ctx, transition)
        samples = pack_intervals(rays, hit, from_spacing(edges, ctx.bounds, transition))
        features = query(field, samples, Quantity.FEATURES, ctx.chunk).features
        assert features is not None
        near, far = edges[:, :1], edges[:, -1:]
        place = (to_spacing(samples.mid.view(len(hit), self.config.samples), ctx.bounds, transition) - near) / (far - near)
        phases = place[..., None] * math.pi * 2.0 ** torch.arange(self.config.octaves, device=place.device)
        where = torch.cat([place[..., None], phases.sin(), phases.cos()], dim=2)
        tokens = torch.cat([features.view(*place.shape, self.config.features), where], dim=2)
        return samples, self.norm(self.blocks(self.embed(tokens)))

    def _radiance(self, tokens: Float[Tensor, "k s w"], direction: Float[Tensor, "k 3"]) -> Float[Tensor, "k s 3"]:
        if self.config.direction_degree:
            seen = harmonics.basis(direction, self.config.direction_degree - 1)
            tokens = torch.cat([tokens, seen[:, None].expand(-1, tokens.shape[1], -1)], dim=2)
        return self.colour_net(tokens).sigmoid()

    def _normals(self, field: Field, rays: Rays, mean: Float[Tensor, " n"], ctx: Context) -> Float[Tensor, "n 3"]:
        def mean_distance(turned: Rays) -> Float[Tensor, " n"]:
            turned = ctx.bounds.clip(turned)
            hit = hit_indices(turned)
            samples, tokens = self._tokens(field, turned, hit, ctx)
            weights = self.weights(tokens)
            distance = (weights * samples.mid.view_as(weights)).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-6)
            return turned.near.index_copy(0, hit, distance)

        return normals_from_distances(rays, mean.detach(), mean_distance)
