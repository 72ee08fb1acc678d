"""Conversion of a density field to visible surface points, from which Gaussians are initialised."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Field, Quantity
from invgraphics.core.rays import Rays
from invgraphics.core.samples import Samples
from invgraphics.core.scene import Points, Scene
from invgraphics.errors import InputError

SAMPLES = 512
"""Intervals along a ray."""
NEAREST = 1e-6
"""Share of a ray's length at which its first interval begins at the earliest, where intervals grow with distance."""
RAYS = 512
"""Rays that are sampled at once."""
MAX_RAYS_PER_POINT = 64
"""Rays tried per wanted point before a field counts as nearly empty."""


@torch.no_grad()
def visible_points(field: Field, scene: Scene, count: int) -> Points:
    """Sample points visible from the training views: each on a random ray, at a depth drawn from the rendering weights.

    A pixel of opacity alpha gives a point with probability alpha, so points are as dense as what is seen; what is hidden inside
    a solid gets none. Randomness comes from torch's global generator.

    Args:
        field: a fitted field of density and radiance, in the scene's local frame.
        scene: whose training cameras and bounds are used.
        count: points wanted; fewer are returned where the field is nearly empty.

    Returns:
        Positions, and the radiance towards the camera that saw them, in the scene's colour space.

    Raises:
        InputError: the field has no density and radiance, or is empty.
    """
    require_density(field)
    device = next((parameter.device for parameter in field.parameters()), torch.device("cpu"))
    parts, found = [], 0
    for rays in _random_rays(scene, MAX_RAYS_PER_POINT * count):
        part = _sample_surface_points(field, rays.to(device), scene.bounds.to(device))
        parts.append(part)
        found += len(part)
        if found >= count:
            break
    if found == 0:
        raise InputError(f"The field shows nothing to the training views of scene '{scene.name}'.", "Fit it for longer.")
    position, rgb = (torch.cat([getattr(part, name) for part in parts])[:count].cpu() for name in ("position", "rgb"))
    return Points(position, rgb)


def require_density(field: Field) -> None:
    """Refuse a field without density and radiance.

    Raises:
        InputError: it has none; the sentence names what it has.
    """
    if Quantity.DENSITY | Quantity.RADIANCE not in field.provides:
        remedy = "Any field with density and radiance can be converted."
        raise InputError(f"{type(field).__name__} provides {field.provides.words()}, not density and radiance.", remedy)


def _random_rays(scene: Scene, most: int) -> Iterator[Rays]:
    """Generate batches of rays through random pixels that masks leave, each batch of one random training view."""
    for _ in range(-(-most // RAYS)):
        view = scene.train[int(torch.randint(len(scene.train), ()))]
        camera = view.camera
        valid = view.valid().reshape(-1).nonzero()[:, 0]
        flat = valid[torch.randint(len(valid), (RAYS,))]
        yield camera.rays(camera.pixel_centres_of(flat))


def _sample_surface_points(field: Field, rays: Rays, bounds: Bounds) -> Points:
    """Sample at most one point per ray by its rendering weights; rays pass through with probability 1 - alpha."""
    samples, weights = uniform_rendering_weights(field, rays, bounds)
    # Inverse of the cumulated weight; a draw beyond a ray's alpha goes through.
    cumulated = weights.cumsum(dim=1)
    draw = torch.rand(len(rays), 1).to(cumulated)
    hit = (draw < cumulated[:, -1:])[:, 0].nonzero()[:, 0]
    chosen = samples[hit * SAMPLES + torch.searchsorted(cumulated[hit], draw[hit], right=True)[:, 0]]
    radiance = field.query(chosen, Quantity.RADIANCE).radiance
    assert radiance is not None
    jitter = (torch.rand(len(chosen), 1).to(cumulated) - 0.5) * chosen.delta[:, None]
    return Points(chosen.position + jitter * chosen.direction, radiance)


def uniform_rendering_weights(field: Field, rays: Rays, bounds: Bounds) -> tuple[Samples, Float[Tensor, "n samples"]]:
    """Rendering weights of `SAMPLES` intervals along each ray, and the samples that they belong to, packed."""
    rays = bounds.clip(rays)
    edges = _edges(rays, bounds)
    index = torch.arange(len(rays), device=edges.device).repeat_interleave(SAMPLES)
    samples = Samples.on(rays, index, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1))
    density = field.query(samples, Quantity.DENSITY).density
    assert density is not None
    weights, _, _ = kernels.composite(density * samples.delta, density[:, None], index, len(rays))
    return samples, weights.view(len(rays), SAMPLES)


def _edges(rays: Rays, bounds: Bounds) -> Float[Tensor, "n samples_plus_1"]:
    """Interval edges along rays: linear in distance in a box, logarithmic in a contracted space."""
    s = torch.linspace(0, 1, SAMPLES + 1, device=rays.near.device)
    near, far = rays.near[:, None], rays.far[:, None]
    if bounds.space != "contracted":
        return near + (far - near) * s
    near = near.maximum(NEAREST * far)
    return near * (far / near) ** s
