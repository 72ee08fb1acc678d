"""Depths of densities that are made from a distance, measured on a surface with known hits."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from invgraphics.core import Bounds, Context, Rays
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.hybrid import Hybrid, make_volumetric
from invgraphics.renderers.neus import NeuS, NeuSConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.sphere_tracing import SphereTracing, SphereTracingConfig
from invgraphics.renderers.volsdf import VolSDF, VolSDFConfig
from invgraphics.runs.analysis import Analysis, Curve

RADIUS, RAYS, EDGE = 0.6, 256, 0.95
"""Of a ball in a box of half-extent 1; parallel rays that meet it, and the share of its radius within which they do."""
STEPS = 256
"""Even steps along a ray."""
WIDTHS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""β, and 1 / s."""
MET = 0.005
"""Mean gap of depth up to which depths count as met, in half-extents of the box."""


def depth_over_width() -> Analysis:
    """Analyse the depths of VolSDF and NeuS on a ball: mean distance from the exact hits over the density's width."""
    curves, met = [], {}
    for label, of in {"VolSDF": volsdf, "VolSDF, density at one point of a step": at_points, "NeuS": neus}.items():
        gaps = [depth_gap(of(width)) for width in WIDTHS]
        curves.append(Curve(label, tuple(-math.log10(width) for width in WIDTHS), tuple(gaps)))
        close = [width for width, gap in zip(WIDTHS, gaps, strict=True) if gap <= MET]
        met[label] = f"{label} from a width of {max(close):g}" if close else f"{label} at none of these widths"
    traced = depth_gap(SphereTracing(SphereTracingConfig()))
    return Analysis(
        title="Depth over the width of the density",
        sentence=f"On a ball, with {STEPS} even steps a ray, mean depths come within {MET:g} half-extents of the exact hits: "
        f"{'; '.join(met.values())}. Sphere tracing is {traced:.1g} away.",
        x="-log10 of the width, half-extents of the box",
        y="mean gap of depth, half-extents of the box",
        curves=tuple(curves),
        logarithmic=True,
    )


def volsdf(width: float, sections: bool = True) -> VolSDF:
    """Render Laplace's density of a held width in even steps."""
    config = VolSDFConfig(StratifiedConfig(STEPS), beta=width, change="held", sections=sections)
    return VolSDF(config, make_volumetric(config.sampler.build(None), 0.0, 0.0))


def at_points(width: float) -> VolSDF:
    """Render the same with the density in the middle of each step standing for the whole step."""
    return volsdf(width, sections=False)


def neus(width: float) -> NeuS:
    """Render the logistic density of a held width in even steps."""
    config = NeuSConfig(StratifiedConfig(STEPS), sharpness=1 / width, change="held")
    return NeuS(config, make_volumetric(config.sampler.build(None), 0.0, 0.0))


@torch.no_grad()
def depth_gap(renderer: Hybrid | SphereTracing) -> float:
    """Mean distance of rendered depths from the exact hits of a ball, over rays evenly spread over its disc."""
    offset, exact = _hits()
    origins = torch.stack([offset, torch.zeros_like(offset), torch.full_like(offset, -1.0)], dim=1)
    rays = Rays.make(origins, origins.new_tensor([[0.0, 0.0, 1.0]]).expand(RAYS, 3))
    corner = origins.new_ones(3)
    ctx = Context(Bounds(-corner, corner, near=0.0))
    rendering, _ = renderer.double().render_rays(Sphere(1.0, RADIUS).double(), rays, ctx)
    return float((rendering.depth - exact).abs().mean())


def _hits() -> tuple[Tensor, Tensor]:
    """Distances of the rays from the ball's axis, and their depths at the ball."""
    share = (torch.arange(RAYS, dtype=torch.float64) + 0.5) / RAYS
    offset = EDGE * RADIUS * share.sqrt()
    return offset, 1 - (RADIUS**2 - offset.square()).sqrt()
