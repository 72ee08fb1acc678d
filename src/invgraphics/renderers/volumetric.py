"""Volume rendering by quadrature along rays (NeRF and all that follow it)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar

import torch

from invgraphics.config import Slot
from invgraphics.core import (
    Context,
    Field,
    FieldValues,
    Quantity,
    RayRenderer,
    Rays,
    Rendering,
    Sampler,
    Samples,
    Scene,
    Trace,
    no_grad_density,
)
from invgraphics.renderers.quadrature import integrate
from invgraphics.renderers.samplers import StratifiedConfig


@dataclass(frozen=True)
class VolumetricConfig:
    """Emission-absorption rendering of a density and a radiance.

    Attributes:
        sampler: where along the rays to look.
    """

    sampler: Annotated[Any, Slot("samplers")] = field(default_factory=StratifiedConfig)

    def build(self, scene: Scene) -> Volumetric:
        """The renderer with its sampler."""
        return Volumetric(self.sampler.build(scene))


class Volumetric(RayRenderer):
    """Integrates a density and a radiance along rays clipped to the scene's bounds."""

    requires: ClassVar[Quantity] = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self, sampler: Sampler) -> None:
        super().__init__()
        self.sampler = sampler

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; normals are added when ``ctx.geometry`` asks for them and the field has some."""
        samples, levels = self.sampler.sample(ctx.bounds.clip(rays), no_grad_density(field), ctx)
        want = self.requires | (field.provides & Quantity.NORMAL if ctx.geometry else Quantity.NONE)
        values = query(field, samples, want, ctx.chunk)
        assert values.density is not None
        return integrate(rays, samples, values, values.density * samples.delta, levels)

    def update(self, field: Field, ctx: Context) -> None:
        """Let the sampler refresh what it remembers of the field."""
        self.sampler.update(no_grad_density(field), ctx)


def query(field: Field, samples: Samples, want: Quantity, chunk: int) -> FieldValues:
    """Ask a field about at most ``chunk`` samples at a time, so that its activations stay small."""
    if len(samples) <= chunk:
        return field.query(samples, want)
    parts = [field.query(samples[start : start + chunk], want) for start in range(0, len(samples), chunk)]
    joined = {}
    for entry in fields(FieldValues):
        values = [getattr(part, entry.name) for part in parts]
        joined[entry.name] = None if values[0] is None else torch.cat(values)
    return FieldValues(**joined)
