"""Volume-rendering quadrature, shared by all renderers that sample rays."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import FieldValues, Rays, Rendering, Samples, Trace
from invgraphics.renderers.base import to_rendering


def sample_weights(density: Float[Tensor, " m"], samples: Samples, rays: int) -> Float[Tensor, " m"]:
    """Weights T (1 - exp(-sigma * length)) of samples in their rays' sums (NeRF, equation 3).

    Args:
        density: sigma at the samples.
        samples: intervals on the rays.
        rays: number of rays.
    """
    weights, _, _ = kernels.composite(density * samples.delta, density[:, None], samples.ray, rays)
    return weights


def heaviest_of_rays(weights: Float[Tensor, " m"], ray: Int[Tensor, " m"], rays: int) -> Bool[Tensor, " m"]:
    """Mark the samples that have the largest weight of their ray, if it is above zero.

    Args:
        weights: of the samples, as `sample_weights` gives them.
        ray: index of each sample's ray.
        rays: number of rays.
    """
    largest = weights.new_zeros(rays).scatter_reduce_(0, ray, weights, reduce="amax")
    return (weights == largest[ray]) & (weights > 0)


def integrate(
    rays: Rays,
    samples: Samples,
    values: FieldValues,
    optical_depth: Float[Tensor, " m"],
    levels: tuple[Trace, ...] = (),
) -> tuple[Rendering, Trace]:
    """Composite samples front to back (Max 1995; NeRF, equation 3), differentiably in everything but the rays' far.

    Args:
        rays: the n rays; depth is their ``far`` where alpha < 0.5.
        samples: intervals on these rays.
        values: radiance, and normals if the picture shall have some.
        optical_depth: sigma * length for a density, -log(1 - alpha) for a renderer that makes its own opacities.
        levels: traces of the passes that led to the samples.
    """
    assert values.radiance is not None, "only radiance can be composited"
    channels = [values.radiance, samples.mid[:, None]]
    if values.normal is not None:
        channels.append(values.normal)
    weights, sums, alpha = kernels.composite(optical_depth, torch.cat(channels, dim=1), samples.ray, len(rays))
    normal = None if values.normal is None else sums[:, 4:]
    rendering = to_rendering(sums[:, :3], alpha, sums[:, 3], normal, rays.far, rays.directions)
    return rendering, Trace(samples, values, weights, levels, rays=len(rays))
