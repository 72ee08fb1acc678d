"""Volume rendering by quadrature along rays (NeRF and its successors)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.config import Slot
from invgraphics.core import (
    Bounds,
    Camera,
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
)
from invgraphics.errors import InputError
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.quadrature import integrate, sample_weights
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.termination import contributing_samples

MAX_SKIPPED_WEIGHT = 1e-3
"""Upper bound, in inference, of the summed weight per ray of samples whose radiance is not evaluated: a quarter of an 8-bit
step."""


@dataclass(frozen=True)
class VolumetricConfig:
    """Emission-absorption rendering of a density and a radiance.

    Attributes:
        sampler: where along the rays to look.
        gradient_reach: gradients of samples nearer to a camera than this are scaled by the square of their distance over it;
            0 leaves them alone. What is near a camera is seen by few pixels, whose gradients would dominate there (Philip
            and Deschaintre 2023, Floaters no more). In endless space it is in local units; in a box in halves of its longest
            edge, and only for rays that begin within it: seen from outside, nothing in it is near.
        colour_threshold: in training, radiance is not evaluated for samples whose weight is at most this; it counts as black
            (DVGO, TensoRF: 1e-4). 0 evaluates all.
    """

    title: ClassVar[str] = "volume rendering"

    sampler: Annotated[Any, Slot("samplers")] = field(default_factory=StratifiedConfig)
    gradient_reach: float = 0.0
    colour_threshold: float = 0.0

    def __post_init__(self) -> None:
        if self.gradient_reach < 0:
            raise ValueError(f"gradient_reach must not be negative, not {self.gradient_reach}")
        if not 0 <= self.colour_threshold < 1:
            raise ValueError(f"colour_threshold must be in [0, 1), not {self.colour_threshold}")

    def build(self, scene: Scene) -> Volumetric:
        """The renderer with its sampler."""
        return Volumetric(self.sampler.build(scene), self.gradient_reach, self.colour_threshold)


class Volumetric(RayRenderer):
    """Volume renderer: integrates density and radiance along rays clipped to the scene's bounds."""

    requires: ClassVar[Quantity] = Quantity.DENSITY | Quantity.RADIANCE
    ends_in_samples: ClassVar[bool] = True

    def __init__(self, sampler: Sampler, gradient_reach: float = 0.0, colour_threshold: float = 0.0) -> None:
        super().__init__()
        self.sampler = sampler
        self.gradient_reach = gradient_reach
        self.colour_threshold = colour_threshold

    @property
    @override
    def required(self) -> Quantity:
        return self.requires | self.sampler.requires

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; with normals if ``ctx.geometry`` is set and the field provides them."""
        samples, levels = self.sampler.sample(ctx.bounds.clip(rays), field, ctx)
        want = self.requires | (field.provides & Quantity.NORMAL if ctx.geometry else Quantity.NONE)
        if Quantity.NORMAL in want and samples.density is None and not torch.is_grad_enabled():
            # Normals cost several density queries, so they are evaluated only where samples contribute.
            samples = replace(samples, density=query(field, samples, Quantity.DENSITY, ctx.chunk).density)
        if samples.density is not None and not torch.is_grad_enabled():
            values = _query_contributing(field, samples, len(rays), want, ctx.chunk)
        elif self.colour_threshold > 0 and ctx.training:
            values = _query_above(self.colour_threshold, field, samples, len(rays), want, ctx.chunk)
        else:
            values = query(field, samples, want, ctx.chunk)
        assert values.density is not None
        if self.gradient_reach > 0 and torch.is_grad_enabled():
            values = _scale_near_gradients(values, samples, rays, ctx.bounds, self.gradient_reach)
            levels = tuple(_scale_level(level, rays, ctx.bounds, self.gradient_reach) for level in levels)
            assert values.density is not None
        return integrate(rays, samples, values, values.density * samples.delta, levels)

    @override
    def render_whole(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace] | None:
        """Fused inference-only rendering, where a kernel supports field and sampler; its trace is empty."""
        rendering = self._render_fused(field, camera, ctx)
        return None if rendering is None else (rendering, Trace())

    def _render_fused(self, field: Field, camera: Camera, ctx: Context) -> Rendering | None:
        """Render without gradients and normals by one fused kernel, where it supports field and sampler; else ``None``."""
        normals = ctx.geometry and Quantity.NORMAL in field.provides
        if torch.is_grad_enabled() or ctx.training or normals:
            return None
        rays = camera.rays()
        composited = self.sampler.composite_fused(ctx.bounds.clip(rays), camera.width, field, ctx, MAX_SKIPPED_WEIGHT)
        if composited is None:
            return None
        sums, alpha = composited
        flat = to_rendering(sums[:, :3], alpha, sums[:, 3], None, rays.far)
        return flat.reshape(camera.height, camera.width)

    def update(self, field: Field, ctx: Context) -> None:
        """Refresh the sampler's state."""
        self.sampler.update(field, ctx)

    @override
    def untrained(self) -> Volumetric:
        """Copy of the renderer with the sampler's constants in place of its learnt state."""
        return Volumetric(self.sampler.untrained(), self.gradient_reach, self.colour_threshold)


def _scale_near_gradients(values: FieldValues, samples: Samples, rays: Rays, bounds: Bounds, reach: float) -> FieldValues:
    """Scale the gradients of samples near their camera by the squared distance; see `VolumetricConfig.gradient_reach`."""
    if bounds.space == "contracted":
        return _scale_gradients(values, _gradient_scale(samples, reach))
    within = bounds.contains(rays.origins.detach())
    if not bool(within.any()):
        return values
    scale = _gradient_scale(samples, reach * float(bounds.half.max()))
    return _scale_gradients(values, scale.where(within[samples.ray], 1.0))


def _scale_level(level: Trace, rays: Rays, bounds: Bounds, reach: float) -> Trace:
    """Scale the gradients of a level that is trained by colours of its own, as mip-NeRF's coarse one."""
    samples, values = level.samples, level.values
    if samples is None or values is None or values.density is None or values.radiance is None:
        return level
    scaled = _scale_near_gradients(values, samples, rays, bounds, reach)
    assert scaled.density is not None
    if scaled is values:
        return level
    return replace(level, values=scaled, weights=sample_weights(scaled.density, samples, len(rays)))


def _gradient_scale(samples: Samples, reach: float) -> Float[Tensor, " m"]:
    """Squared distance of samples along their rays over ``reach``, at most 1."""
    return (samples.mid.detach() / reach).square().clamp_max(1.0)


def _scale_gradients(values: FieldValues, scale: Float[Tensor, " m"]) -> FieldValues:
    """Scale the gradients of density and radiance by ``scale``; values are unchanged."""
    assert values.density is not None
    assert values.radiance is not None
    density = torch.lerp(values.density.detach(), values.density, scale)
    return replace(values, density=density, radiance=torch.lerp(values.radiance.detach(), values.radiance, scale[:, None]))


def _query_contributing(field: Field, samples: Samples, rays: int, want: Quantity, chunk: int) -> FieldValues:
    """Query samples of known density; radiance of samples with negligible weight is skipped and stays zero."""
    assert samples.density is not None
    weights = sample_weights(samples.density, samples, rays)
    visible = contributing_samples(weights, samples.ray, rays, MAX_SKIPPED_WEIGHT)
    found = query(field, samples[visible], want & ~Quantity.DENSITY, chunk)
    values = {entry.name: getattr(found, entry.name) for entry in fields(FieldValues)}
    spread = {
        name: value.new_zeros(len(samples), *value.shape[1:]).index_copy_(0, visible, value)
        for name, value in values.items()
        if value is not None
    }
    return FieldValues(**spread | {"density": samples.density})


def _query_above(threshold: float, field: Field, samples: Samples, rays: int, want: Quantity, chunk: int) -> FieldValues:
    """Query samples in the graph; radiance of those that weigh no more than ``threshold`` is skipped and stays zero."""
    features = field.provides & Quantity.FEATURES
    values = query(field, samples, (want & ~Quantity.RADIANCE) | features, chunk)
    assert values.density is not None
    with torch.no_grad():
        visible = torch.nonzero(sample_weights(values.density, samples, rays) > threshold)[:, 0]
    with_features = replace(samples[visible], features=None if values.features is None else values.features[visible])
    radiance = query(field, with_features, Quantity.RADIANCE, chunk).radiance
    assert radiance is not None
    everywhere = radiance.new_zeros(len(samples), 3).index_copy(0, visible, radiance)
    return replace(values, radiance=everywhere, features=None)


def query(field: Field, samples: Samples, want: Quantity, chunk: int) -> FieldValues:
    """Query a field in chunks of at most ``chunk`` samples, which bounds the memory of its activations.

    Raises:
        InputError: the field returns values of wrong shapes or types, or none of what is wanted.
    """
    if len(samples) <= chunk:
        return _checked(field, samples, want)
    parts = [_checked(field, samples[start : start + chunk], want) for start in range(0, len(samples), chunk)]
    joined = {}
    for entry in fields(FieldValues):
        values = [getattr(part, entry.name) for part in parts]
        joined[entry.name] = None if values[0] is None else torch.cat(values)
    return FieldValues(**joined)


_COLUMNS = {"density": (), "sdf": (), "gradient": (3,), "radiance": (3,), "normal": (3,)}
"""Quantity -> the shape of its value at one sample."""


def _checked(field: Field, samples: Samples, want: Quantity) -> FieldValues:
    """Query a field whose author may have mistaken a shape or type: kernels and indices further on would not say so."""
    values: object = field.query(samples, want)
    if not isinstance(values, FieldValues):
        raise InputError(f"{type(field).__name__}.query returned {type(values).__name__}, no FieldValues.")
    for name, columns in _COLUMNS.items():
        value, expected = getattr(values, name), (len(samples), *columns)
        if value is None and name != "normal" and Quantity[name.upper()] in want:
            raise InputError(f"{type(field).__name__}.query returned no {name}, which it was asked for.")
        if value is not None and tuple(value.shape) != expected:
            sentence = f"{type(field).__name__}.query returned {name} of shape {tuple(value.shape)} for {len(samples)} samples."
            raise InputError(sentence, f"Expected: {expected}.")
        if value is not None and not value.is_floating_point():
            raise InputError(f"{type(field).__name__}.query returned {name} of type {value.dtype}, no floating-point numbers.")
    return values
