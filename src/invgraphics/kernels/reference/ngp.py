"""Rendering and marching of an Instant-NGP field, composed of `ray_march`, `hash_encode` and `composite`."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import linear, relu, softplus

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedNGP
from invgraphics.core.rays import Rays
from invgraphics.kernels.reference.composite import OPAQUE, composite, transmittance
from invgraphics.kernels.reference.hash import hash_encode
from invgraphics.kernels.reference.march import ray_march
from invgraphics.kernels.types import EXP_LIMIT, March, MarchSteps

UNLIMITED = 1 << 62
"""`MarchSteps.limit` that no ray reaches."""


@torch.no_grad()
def ngp_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedNGP,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.ngp_render`; exact: evaluates every occupied interval, whatever the error budget allows."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=UNLIMITED), rays.near)
    return composited(march, *_query(field, rays, bounds, march), len(rays))


@torch.no_grad()
def ngp_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedNGP,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> March:
    """See `invgraphics.kernels.ngp_march`."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=UNLIMITED), start)
    density, _ = _query(field, rays, bounds, march)
    return visible(march, density, len(rays), min_transmittance)


def midpoints(rays: Rays, march: March) -> Float[Tensor, "m 3"]:
    """Positions in the middle of every interval."""
    return rays.origins[march.ray] + ((march.t0 + march.t1) / 2)[:, None] * rays.directions[march.ray]


def activated_density(raw: Float[Tensor, " m"], activation: Literal["exp", "softplus", "relu"]) -> Float[Tensor, " m"]:
    """Densities of raw values, to which their bias is added already."""
    return {"exp": raw.clamp_max(EXP_LIMIT).exp(), "softplus": softplus(raw), "relu": relu(raw)}[activation]


def composited(
    march: March, density: Float[Tensor, " m"], radiance: Float[Tensor, "m 3"], rays: int
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """Sums of weight * (radiance, distance), and of the weights, over the intervals of every ray."""
    channels = torch.cat([radiance, ((march.t0 + march.t1) / 2)[:, None]], dim=1)
    _, sums, alpha = composite(density * (march.t1 - march.t0), channels, march.ray, rays)
    return sums, alpha


def visible(march: March, density: Float[Tensor, " m"], rays: int, min_transmittance: float) -> March:
    """The intervals that at least ``min_transmittance`` of the light reaches."""
    tau = (density * (march.t1 - march.t0)).double().clamp_max(OPAQUE)
    kept = transmittance(tau, march.ray, rays) >= min_transmittance
    return March(march.ray[kept], march.t0[kept], march.t1[kept], march.resume)


def _query(field: FusedNGP, rays: Rays, bounds: Bounds, march: March) -> tuple[Float[Tensor, " m"], Float[Tensor, "m 3"]]:
    """Density and radiance at the midpoint of every interval."""
    direction = rays.directions[march.ray]
    position = midpoints(rays, march)
    features, _ = hash_encode(bounds.to_unit(position), field.table, field.grid)
    outputs = relu_network(field.density_net, features)
    density = activated_density(outputs[:, 0] + field.density_bias, field.density_activation)
    if field.contracted_density > 0:
        density = density * (field.contracted_density * bounds.radial_scale(position))
    inputs = outputs[:, 1:]
    if field.sh_bands:
        inputs = torch.cat([inputs, harmonics.basis(direction, field.sh_bands - 1)], dim=1)
    colour = relu_network(field.colour_net, inputs)
    return density, colour.sigmoid() if field.colour_space == "srgb" else softplus(colour)


def relu_network(layers: tuple[tuple[Tensor, Tensor], ...], x: Float[Tensor, "m ins"]) -> Float[Tensor, "m outs"]:
    """Outputs of an MLP whose layers before the last are rectified."""
    for weight, bias in layers[:-1]:
        x = relu(linear(x, weight, bias))
    return linear(x, *layers[-1])
