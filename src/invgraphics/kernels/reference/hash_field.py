"""A hash grid and its networks as a whole, by the operations they are made of."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import linear, relu, softplus

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.rays import Rays
from invgraphics.kernels.reference.composite import composite
from invgraphics.kernels.reference.hash import hash_encode
from invgraphics.kernels.reference.march import ray_march
from invgraphics.kernels.types import EXP_LIMIT, HashField, March, MarchSteps


@torch.no_grad()
def hash_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: HashField,
    transmittance: float = 0.0,
    unseen: float = 0.0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.hash_render`; every occupied step is looked at, whatever may be left out."""
    march = _whole_march(rays, occupied, bounds, steps, rays.near)
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
    march = _whole_march(rays, occupied, bounds, steps, start)
    density, _ = _look(field, rays, bounds, march)
    depth = (density * (march.t1 - march.t0)).double()
    counts = torch.bincount(march.ray, minlength=len(rays))
    before = torch.cat([depth.new_zeros(1), depth.cumsum(0)])[:-1]
    before = before - before[(counts.cumsum(0) - counts)[march.ray]]
    kept = torch.exp(-before) >= transmittance
    return March(march.ray[kept], march.t0[kept], march.t1[kept], march.resume)


def _whole_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: MarchSteps, start: Float[Tensor, " n"]
) -> March:
    """All the way to the end, however many steps are kept."""
    parts = [ray_march(rays, occupied, bounds, steps, start)]
    while bool((parts[-1].resume < rays.far).any()):
        parts.append(ray_march(rays, occupied, bounds, steps, parts[-1].resume))
    ray, t0, t1 = (torch.cat([getattr(part, name) for part in parts]) for name in ("ray", "t0", "t1"))
    order = torch.argsort(ray, stable=True)
    return March(ray[order], t0[order], t1[order], parts[-1].resume)


def _look(field: HashField, rays: Rays, bounds: Bounds, march: March) -> tuple[Float[Tensor, " m"], Float[Tensor, "m 3"]]:
    """Density and radiance in the middle of every step."""
    direction = rays.directions[march.ray]
    position = rays.origins[march.ray] + ((march.t0 + march.t1) / 2)[:, None] * direction
    features, _ = hash_encode(bounds.to_unit(position), field.table, field.grid)
    outputs = _network(field.geometry, features)
    raw = outputs[:, 0] + field.bias
    density = {"exp": raw.clamp_max(EXP_LIMIT).exp(), "softplus": softplus(raw), "relu": relu(raw)}[field.density]
    inputs = outputs[:, 1:]
    if field.bands:
        inputs = torch.cat([inputs, harmonics.basis(direction, field.bands - 1)], dim=1)
    colour = _network(field.colour, inputs)
    return density, colour.sigmoid() if field.colour_space == "srgb" else softplus(colour)


def _network(layers: tuple[tuple[Tensor, Tensor], ...], x: Float[Tensor, "m ins"]) -> Float[Tensor, "m outs"]:
    for weight, bias in layers[:-1]:
        x = relu(linear(x, weight, bias))
    return linear(x, *layers[-1])
