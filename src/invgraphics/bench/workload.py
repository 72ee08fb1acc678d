"""Synthetic workload of the benchmarks: Gaussians on a sphere, a box and a plane, similar to a fitted scene."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Bounds, Camera, Gaussians, Points, Scene, View
from invgraphics.core.colour import quantise
from invgraphics.core.harmonics import BAND_0, count
from invgraphics.core.transforms import look_at
from invgraphics.fields.gaussian import GaussianField
from invgraphics.fields.starting import starting_scales

SCALE = 0.7
"""Standard deviations relative to the distance of neighbours."""
SH_DEGREE = 3
DISTANCE, FOCAL = 3.0, 1.6
"""Distance of the cameras from their target, and focal length relative to the image's edge: the object fills it."""
MIDDLE = (0.0, 0.0, -0.3)
"""Look-at target of the cameras."""


def bounds() -> Bounds:
    """Bounding cube of the object."""
    return Bounds(-torch.ones(3), torch.ones(3))


def gaussian_field(n: int, seed: int = 0) -> GaussianField:
    """n Gaussians on surfaces: about 0.7 neighbour distances wide, anisotropic, opacity logits N(0, 2), SH of degree 3."""
    generator = torch.Generator().manual_seed(seed)
    means = _surface(n, generator)
    scales = SCALE * starting_scales(means, bounds())[:, None] * torch.exp(0.5 * torch.randn(n, 3, generator=generator))
    colour = 0.5 + 0.5 * torch.sin(4 * means + torch.tensor([0.0, 2.0, 4.0]))
    tensors = {
        "means": means,
        "quaternions": torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1),
        "log_scales": scales.log(),
        "opacity_logits": 2 * torch.randn(n, generator=generator),
        "sh_dc": ((colour - 0.5) / BAND_0)[:, None, :],
        "sh_rest": 0.05 * torch.randn(n, count(SH_DEGREE) - 1, 3, generator=generator),
    }
    return GaussianField(tensors)


def _surface(n: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Points on a sphere (a third), a box (a third) and the ground under both."""
    sphere, box = n // 3, n // 3
    ball = torch.nn.functional.normalize(torch.randn(sphere, 3, generator=generator), dim=1)
    cube = torch.rand(box, 3, generator=generator) * 2 - 1
    side = torch.randint(3, (box,), generator=generator)
    cube[torch.arange(box), side] = cube[torch.arange(box), side].sign()
    ground = torch.rand(n - sphere - box, 3, generator=generator) * 1.8 - 0.9
    ground[:, 2] = -0.6
    return torch.cat([0.4 * ball + torch.tensor([-0.4, 0.1, -0.2]), 0.3 * cube + torch.tensor([0.45, -0.1, -0.3]), ground])


def activated(field: GaussianField) -> Gaussians:
    """Activated parameters of the field as differentiable leaf tensors."""
    with torch.no_grad():
        stored = torch.cat([field.sh_dc, field.sh_rest], dim=1)
        tensors = (field.means, field.quaternions, field.log_scales.exp(), field.opacity_logits.sigmoid(), stored)
    return Gaussians(*(tensor.detach().clone().requires_grad_() for tensor in tensors))


def leaves(gaussians: Gaussians) -> list[Tensor]:
    """Parameter tensors of a set of Gaussians."""
    return [gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh]


def camera(width: int, turn: float = 0.1) -> Camera:
    """A square camera that looks at the object from above; ``turn`` in revolutions about the vertical."""
    azimuth, height = 2 * math.pi * turn, 0.6
    eye = [math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)]
    middle = torch.tensor(MIDDLE)
    pose = look_at(middle + DISTANCE * torch.tensor(eye), middle, torch.tensor([0.0, 0.0, 1.0]))
    return Camera(pose, torch.full((2,), FOCAL * width), torch.full((2,), width / 2), width, width)


@torch.no_grad()
def scene(field: GaussianField, views: int, width: int) -> Scene:
    """Training scene: renderings of the Gaussians with alpha, from cameras all around."""
    gaussians = activated(field)
    train = []
    for i in range(views):
        viewpoint = camera(width, i / views)
        footprints, rgb = kernels.splat_project(gaussians, viewpoint)
        image, alpha = kernels.splat_rasterise(footprints, rgb, width, width)
        train.append(View(viewpoint, quantise(image / alpha[..., None].clamp_min(1e-3)), f"{i}", alpha=quantise(alpha)))
    points = Points(field.means.detach(), (0.5 + BAND_0 * field.sh_dc[:, 0].detach()).clamp(0, 1))
    return Scene("benchmark", tuple(train), (), torch.ones(3), bounds(), points=points)


def occupied(resolution: int, points: int = 200_000) -> Bool[Tensor, "r r r"]:
    """Occupancy grid: cells that the object's surface passes through, dilated by one."""
    unit = bounds().to_unit(_surface(points, torch.Generator().manual_seed(0)))
    x, y, z = (unit * resolution).long().clamp(0, resolution - 1).unbind(1)
    cells = torch.zeros(resolution, resolution, resolution)
    cells[x, y, z] = 1
    return torch.nn.functional.max_pool3d(cells[None, None], 3, stride=1, padding=1)[0, 0] > 0
