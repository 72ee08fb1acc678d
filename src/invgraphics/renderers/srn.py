"""Scene representation networks: a recurrent network marches each ray through a field of features to one surface point.

Sitzmann, Zollhöfer and Wetzstein 2019, arXiv 1906.01618, §3.2: per step, ``(h, c) = LSTM(features(x), (h, c))`` and
``t += W h + b``; a pixel network turns the features at the last point into a colour.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import (
    Camera,
    Context,
    Contributions,
    Field,
    FieldValues,
    Quantity,
    RayRenderer,
    Rays,
    Rendering,
    Samples,
    Scene,
    Trace,
)
from invgraphics.core.spacing import from_spacing, to_spacing
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.ray_normals import normals_from_distances
from invgraphics.renderers.samplers import hit_indices
from invgraphics.renderers.volumetric import query

STATE_GRADIENT = 10.0
"""Gradients of the recurrent state are clamped here (SRN's code)."""


@dataclass(frozen=True)
class SRNConfig:
    """Ray marching by an LSTM, and a pixel network.

    Attributes:
        features: of the field.
        steps: of the march (SRN: 10).
        hidden: width of the LSTM's state (SRN: 16).
        layers: hidden layers of the pixel network (SRN: 4, counted with its output 5).
        width: of each (SRN: 256).
        stride: length of every step of an untrained march, in mean half-extents of the box; with SRN's 0 the first
            points of all rays lie at the cameras' end of the box.
        jitter: most that the first point is moved along its ray in training, evenly from 0, in mean half-extents (SRN moves it
            by a normal deviate with a standard deviation of 0.0005).
    """

    title: ClassVar[str] = "learned aggregation"

    features: int = 256
    steps: int = 10
    hidden: int = 16
    layers: int = 4
    width: int = 256
    stride: float = 0.1
    jitter: float = 5e-4

    def __post_init__(self) -> None:
        if min(self.features, self.steps, self.hidden, self.width) < 1 or self.layers < 0:
            raise ValueError("features, steps, hidden and width must be at least 1, layers at least 0.")
        if self.jitter < 0:
            raise ValueError(f"jitter must not be negative, not {self.jitter}.")

    def build(self, scene: Scene) -> SRN:
        """The renderer, its weights drawn from torch's global generator; its lengths are those of ``scene``'s box."""
        return SRN(self)


class SRN(RayRenderer):
    """Renderer with one surface point per ray, found by a recurrent network, and a colour and an opacity from its features.

    The paper's pixel network has no opacity, and its pictures one background; here it has, so that pictures can be seen in
    front of any background. Distances stay within the ray's interval; a gradient that would bring one back from an end passes.

    Attributes:
        cell: the LSTM's cell.
        step: state to length of the next step, in mean half-extents.
        pixel_net: features at the last point to raw colour and opacity.
    """

    requires: ClassVar[Quantity] = Quantity.FEATURES

    def __init__(self, config: SRNConfig) -> None:
        super().__init__()
        self.config = config
        self.cell = nn.LSTMCell(config.features, config.hidden)
        self.step = nn.Linear(config.hidden, 1)
        with torch.no_grad():
            forget = slice(config.hidden, 2 * config.hidden)
            self.cell.bias_ih[forget] = 1.0  # the state is kept at first (Jozefowicz et al. 2015)
            self.cell.bias_hh[forget] = 0.0
            self.step.bias.fill_(config.stride)
        self.pixel_net = pixel_network(config.features, config.layers, config.width, 4)

    @property
    @override
    def feature_width(self) -> int:
        return self.config.features

    def march(self, field: Field, rays: Rays, ctx: Context) -> Iterator[Float[Tensor, " n"]]:
        """Distances of a ray's points: the first, and that after each step; rays have near < far."""
        unit = float(ctx.bounds.half.mean()) / (1.0 if ctx.bounds.space == "box" else 2 * ctx.bounds.radius)
        near, far = to_spacing(rays.near, ctx.bounds), to_spacing(rays.far, ctx.bounds)
        place, state = near, None
        if ctx.training and self.config.jitter > 0:
            place = (near + self.config.jitter * unit * ctx.rand((len(rays),), like=near)).minimum(far)
        yield from_spacing(place, ctx.bounds)
        index = torch.arange(len(rays), device=near.device)
        for _ in range(self.config.steps):
            state = self.cell(_features(field, rays, index, from_spacing(place, ctx.bounds), ctx), state)
            if state[0].requires_grad:
                state[0].register_hook(lambda gradient: gradient.clamp(-STATE_GRADIENT, STATE_GRADIENT))
            place = within(place + unit * self.step(state[0])[:, 0], near, far)
            yield from_spacing(place, ctx.bounds)

    def distances(self, field: Field, rays: Rays, ctx: Context) -> Float[Tensor, " n"]:
        """Distance of each ray's last point; ``near`` for rays that miss the bounds."""
        hit = hit_indices(rays)
        *_, last = self.march(field, rays[hit], ctx)
        return rays.near.index_copy(0, hit, last)

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; with normals, from the points of neighbouring rays, if ``ctx.geometry`` is set."""
        far, rays = rays.far, ctx.bounds.clip(rays)
        hit = hit_indices(rays)
        seen = rays[hit]
        *_, last = self.march(field, seen, ctx)
        raw = self.pixel_net(_features(field, rays, hit, last, ctx))
        radiance, weight = raw[:, :3].sigmoid(), raw[:, 3].sigmoid()
        samples = Samples.on(rays, hit, last, last)
        sums = weight[:, None] * torch.cat([radiance, torch.ones_like(last)[:, None], last[:, None]], dim=1)
        sums = sums.new_zeros(len(rays), 5).index_copy(0, hit, sums)
        normal = None
        if ctx.geometry:
            steady = replace(ctx, training=False)
            facing = normals_from_distances(
                seen, last.detach(), lambda turned: self.distances(field, ctx.bounds.clip(turned), steady)
            )
            normal = torch.zeros_like(rays.directions).index_copy(0, hit, facing)
        rendering = to_rendering(sums[:, :3], sums[:, 3], sums[:, 4], normal, far, rays.directions)
        return rendering, Trace(samples, FieldValues(radiance=radiance), weight, rays=len(rays))

    @override
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """The one surface point of the pixel's ray; see `Renderer.contributions`."""
        return replace(super().contributions(field, camera, pixel, ctx), kind="surface points")


def pixel_network(inputs: int, layers: int, width: int, outputs: int) -> nn.Sequential:
    """Hidden layers with layer normalisation and ReLU, and a linear output layer."""
    widths = [inputs] + [width] * layers
    hidden: list[nn.Module] = []
    for before, after in pairwise(widths):
        hidden += [nn.Linear(before, after), nn.LayerNorm(after), nn.ReLU()]
    return nn.Sequential(*hidden, nn.Linear(widths[-1], outputs))


class _Within(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(x < low, x > high)
        return torch.maximum(torch.minimum(x, high), low)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        below, above = ctx.saved_tensors
        (gradient,) = grad_outputs
        free = ~(below & (gradient > 0)) & ~(above & (gradient < 0))
        return gradient * free, gradient * below, gradient * above


def within(x: Float[Tensor, " n"], low: Float[Tensor, " n"], high: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Clamp to [low, high]; where a value is cut off, descent may bring it back, but not push it further.

    That is no gradient of the clamp: where points are cut off, gradients in the camera's pose, on which the limits and earlier
    points depend too, are wrong.
    """
    result = _Within.apply(x, low, high)
    assert isinstance(result, Tensor)
    return result


def _features(field: Field, rays: Rays, index: Int[Tensor, " k"], t: Float[Tensor, " k"], ctx: Context) -> Float[Tensor, "k f"]:
    features = query(field, Samples.on(rays, index, t, t), Quantity.FEATURES, ctx.chunk).features
    assert features is not None
    return features
