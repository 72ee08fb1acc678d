"""A hash grid and its networks as a whole, by the operations they are made of."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import linear, relu, softplus

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.reference.composite import OPAQUE, composite
from invgraphics.kernels.reference.composite import transmittance as light_reaching
from invgraphics.kernels.reference.hash import hash_encode
from invgraphics.kernels.reference.march import ray_march
from invgraphics.kernels.types import EXP_LIMIT, HashField, March, MarchSteps

ENDLESS = 1 << 62
"""More steps than any ray has."""


@torch.no_grad()
def hash_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: HashField,
    transmittance: float = 0.0,
    unseen: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.hash_render`; every occupied step is looked at, whatever may be left out, in any order."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=ENDLESS), rays.near)
    density, radiance = _look(field, rays, bounds, march)
    channels = torch.cat([radiance, ((march.t0 + march.t1) / 2)[:, None]], dim=1)
    _, sums, alpha = composite(density * (march.t1 - march.t0), channels, march.ray, len(rays))
    return sums, alpha


@torch.no_grad()
def hash_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: HashField,
    start: Float[Tensor, " n"],
    transmittance: float,
) -> March:
    """See `invgraphics.kernels.hash_march`."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=ENDLESS), start)
    density, _ = _look(field, rays, bounds, march)
    tau = (density * (march.t1 - march.t0)).double().clamp_max(OPAQUE)
    kept = light_reaching(tau, march.ray, len(rays)) >= transmittance
    return March(march.ray[kept], march.t0[kept], march.t1[kept], march.resume)


def _look(field: HashField, rays: Rays, bounds: Bounds, march: March) -> tuple[Float[Tensor, " m"], Float[Tensor, "m 3"]]:
    """Density and radiance in the middle of every step."""
    direction = rays.directions[march.ray]
    position = rays.origins[march.ray] + ((march.t0 + march.t1) / 2)[:, None] * direction
    features, _ = hash_encode(bounds.to_unit(position), field.table, field.grid)
    outputs = _network(field.geometry, features)
    raw = outputs[:, 0] + field.bias
    density = {"exp": raw.clamp_max(EXP_LIMIT).exp(), "softplus": softplus(raw), "relu": relu(raw)}[field.density]
    if field.contracted_density > 0:
        density = density * (field.contracted_density * bounds.radial_scale(position))
    inputs = outputs[:, 1:]
    if field.bands:
        inputs = torch.cat([inputs, harmonics.basis(direction, field.bands - 1)], dim=1)
    colour = _network(field.colour, inputs)
    return density, colour.sigmoid() if field.colour_space == "srgb" else softplus(colour)


def _network(layers: tuple[tuple[Tensor, Tensor], ...], x: Float[Tensor, "m ins"]) -> Float[Tensor, "m outs"]:
    for weight, bias in layers[:-1]:
        x = relu(linear(x, weight, bias))
    return linear(x, *layers[-1])
