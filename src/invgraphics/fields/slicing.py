"""Slicing of a density field into a multi-plane image."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Camera, Field, Planes, Quantity, Rays, Samples
from invgraphics.core.bounds import CONTRACTED_FAR, Bounds
from invgraphics.fields.convert import require_density

SUBSAMPLES = 8
"""Intervals of each plane's slab along a ray."""
EMPTY = 1e-4
"""Opacity of a texel below which it has no colour of its own."""
ROWS = 4096
"""Rays that are looked along at once."""


@torch.no_grad()
def slice_density(field: Field, camera: Camera, depths: Float[Tensor, " p"], bounds: Bounds) -> Planes:
    """Multi-plane image whose layers hold what a field's density and radiance are in the slabs around its planes.

    Slabs meet half-way in inverse depth. A texel's opacity is 1 - exp(-∫ σ dt) over its slab along the reference camera's ray,
    its colour the mean radiance towards that camera, by rendering weight. From the reference camera the image so equals the
    volume rendering of what lies beyond the first slab's near end; nothing before that is in it. From elsewhere it is the
    better the more planes there are.

    Args:
        field: provides density and radiance, local frame.
        camera: reference camera, as wide as the planes.
        depths: of the planes, ascending.
        bounds: of the field; in endless space the last slab reaches to where rays end.

    Raises:
        InputError: the field has no density and radiance.
    """
    require_density(field)
    device = next((parameter.device for parameter in field.parameters()), torch.device("cpu"))
    edges = slab_edges(depths, bounds)
    parts = []
    for rays in camera.rays().chunks(max(1, ROWS // len(depths))):
        cosine = rays.directions @ camera.cam_to_world[:3, 2]
        parts.append(_slabs(field, rays.to(device), (edges / cosine[:, None]).to(device), bounds.to(device)).cpu())
    rgba = torch.cat(parts).view(camera.height, camera.width, len(depths), 4).permute(2, 3, 0, 1)
    return Planes(camera, depths, _bled(rgba[:, :3], rgba[:, 3]), rgba[:, 3].contiguous())


def _bled(rgb: Float[Tensor, "p 3 h w"], alpha: Float[Tensor, "p h w"]) -> Float[Tensor, "p 3 h w"]:
    """Straight colours with those of empty texels taken from their neighbours, which interpolation mixes them with."""
    weight = alpha[:, None]
    near = torch.nn.functional.avg_pool2d(torch.cat([rgb * weight, weight], dim=1), 3, stride=1, padding=1)
    return torch.where(weight < EMPTY, near[:, :3] / near[:, 3:].clamp_min(1e-12), rgb)


def slab_edges(depths: Float[Tensor, " p"], bounds: Bounds) -> Float[Tensor, " p_times_subsamples_plus_1"]:
    """Depths of the ends of all intervals, `SUBSAMPLES` in each slab, evenly spaced in inverse depth."""
    inverse = 1 / depths.double()
    middle = (inverse[1:] + inverse[:-1]) / 2
    last = 1 / (CONTRACTED_FAR * float(bounds.half.max())) if bounds.space == "contracted" else inverse[-1] * 0.5
    behind = torch.clamp(2 * inverse[-1:] - middle[-1:], min=last)
    ends = torch.cat([2 * inverse[:1] - middle[:1], middle, behind if bounds.space == "box" else behind.new_tensor([last])])
    share = torch.arange(SUBSAMPLES, dtype=torch.float64) / SUBSAMPLES
    inside = ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * share
    return (1 / torch.cat([inside.reshape(-1), ends[-1:]])).to(depths)


def _slabs(field: Field, rays: Rays, edges: Float[Tensor, "n e"], bounds: Bounds) -> Float[Tensor, "n p 4"]:
    """Straight colour and opacity of each slab along each ray."""
    n, intervals = len(rays), edges.shape[1] - 1
    index = torch.arange(n, device=edges.device).repeat_interleave(intervals)
    samples = Samples.on(rays, index, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1))
    values = field.query(samples, Quantity.DENSITY | Quantity.RADIANCE)
    assert values.density is not None
    assert values.radiance is not None
    thickness = values.density * samples.delta * bounds.contains(samples.position)
    slab = torch.arange(n * intervals, device=edges.device) // SUBSAMPLES
    _, sums, alpha = kernels.composite(thickness, values.radiance, slab, n * intervals // SUBSAMPLES)
    straight = sums[:, :3] / alpha[:, None].clamp_min(1e-6)
    return torch.cat([straight, alpha[:, None]], dim=1).view(n, -1, 4)
