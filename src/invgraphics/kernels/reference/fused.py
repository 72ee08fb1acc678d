"""Rendering and marching of fields over lattices, composed of `ray_march`, `lattice_encode` and `composite`."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import linear, relu, softplus

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.fused import ColourHead, CombinedLattices, DensityHead, FusedLattice, HiddenActivation, Layers
from invgraphics.core.rays import Rays
from invgraphics.kernels.reference.lattice import lattice_encode
from invgraphics.kernels.reference.march import ray_march
from invgraphics.kernels.reference.ngp import UNLIMITED, activated_density, composited, midpoints, visible
from invgraphics.kernels.types import March, MarchSteps


@torch.no_grad()
def lattice_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedLattice,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """See `invgraphics.kernels.lattice_render`; exact: evaluates every occupied interval, whatever the error budget allows."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=UNLIMITED), rays.near)
    position = midpoints(rays, march)
    unit, inside = _cropped(field, bounds.to_unit(position))
    outputs = _geometry(field, unit)
    features = outputs[:, 1:]
    if field.appearance is not None:
        own = _network(field.basis, _encoded(field.appearance, unit), field.hidden)
        features = torch.cat([features, own], dim=1)
    density = _density(field.density, outputs[:, 0], bounds, position) * inside
    radiance = _radiance(field.colour, features, rays.directions[march.ray], field.hidden)
    return composited(march, density, radiance, len(rays))


@torch.no_grad()
def lattice_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: MarchSteps,
    field: FusedLattice,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> March:
    """See `invgraphics.kernels.lattice_march`."""
    march = ray_march(rays, occupied, bounds, replace(steps, limit=UNLIMITED), start)
    position = midpoints(rays, march)
    unit, inside = _cropped(field, bounds.to_unit(position))
    density = _density(field.density, _geometry(field, unit)[:, 0], bounds, position) * inside
    return visible(march, density, len(rays), min_transmittance)


def _cropped(field: FusedLattice, unit: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, " m"]]:
    """Unit coordinates in the field's box, and whether they lie in it."""
    if field.crop is None:
        return unit, torch.ones_like(unit[:, 0], dtype=torch.bool)
    lo, hi = (unit.new_tensor(corner) for corner in field.crop)
    unit = (unit - lo) / (hi - lo)
    return unit, ((unit >= 0) & (unit <= 1)).all(dim=1)


def _encoded(encoding: CombinedLattices, unit: Float[Tensor, "m 3"]) -> Float[Tensor, "m f"]:
    return encoding.scale * lattice_encode(unit, encoding.lattices, encoding.combine)


def _network(layers: Layers, x: Float[Tensor, "m ins"], hidden: HiddenActivation) -> Float[Tensor, "m outs"]:
    for weight, bias in layers[:-1]:
        x = linear(x, weight, bias)
        x = relu(x) if hidden == "relu" else softplus(x)
    return linear(x, *layers[-1]) if layers else x


def _geometry(field: FusedLattice, unit: Float[Tensor, "m 3"]) -> Float[Tensor, "m o"]:
    """Raw density, and behind it the features that colour gets."""
    return _network(field.geometry_net, _encoded(field.geometry, unit), field.hidden)


def _density(head: DensityHead, raw: Float[Tensor, " m"], bounds: Bounds, position: Tensor) -> Float[Tensor, " m"]:
    density = activated_density(raw + head.bias, head.activation)
    if head.contracted > 0:
        density = density * (head.contracted * bounds.radial_scale(position))
    return density * head.scale


def _radiance(
    head: ColourHead, features: Float[Tensor, "m f"], direction: Float[Tensor, "m 3"], hidden: HiddenActivation
) -> Float[Tensor, "m 3"]:
    raw = features
    if head.kind == "sh":
        raw = harmonics.evaluate(features.unflatten(1, (3, -1)).mT, direction)
    elif head.kind == "mlp":
        if head.octaves:
            octaves = torch.arange(head.octaves, device=features.device)
            phases = (features[:, :, None] * 2.0**octaves).flatten(1)
            raw = torch.cat([features, phases.sin(), phases.cos()], dim=1)
        raw = _network(head.net, torch.cat([raw, _seen_from(head, direction)], dim=1), hidden)
    if head.activation == "sigmoid":
        return raw.sigmoid() * (1 + 2 * head.padding) - head.padding
    return softplus(raw) if head.activation == "softplus" else relu(raw + 0.5)


def _seen_from(head: ColourHead, direction: Float[Tensor, "m 3"]) -> Float[Tensor, "m d"]:
    """Features of the direction."""
    if head.direction == "sh":
        return harmonics.basis(direction, head.degree - 1)
    if head.direction == "none":
        return direction[:, :0]
    scales = torch.pi * 2.0 ** torch.arange(head.degree, dtype=direction.dtype, device=direction.device)
    phases = (direction[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([direction, phases.sin(), phases.cos()], dim=1)
