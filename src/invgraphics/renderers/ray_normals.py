"""Normals of surfaces that are known by their distance along any ray only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import Rays

LEAST_TURN = 1e-3
"""Least angle in radians to a neighbouring ray: below it, float32 distances differ by rounding."""


@torch.no_grad()
def normals_from_distances(
    rays: Rays, distance: Float[Tensor, " n"], distance_along: Callable[[Rays], Float[Tensor, " n"]]
) -> Float[Tensor, "n 3"]:
    """Unit normals of the plane through the surface points of a ray and of two others, turned by a pixel's footprint.

    Args:
        rays: n rays.
        distance: of their surface points.
        distance_along: distance of the surface along other n rays from the same origins, over [0, inf).

    Returns:
        Normals that face the camera; the ray's own direction, reversed, where the three points lie on a line.
    """
    helper = torch.where(
        rays.directions[:, 2:].abs() < 0.9,
        rays.directions.new_tensor([0.0, 0.0, 1.0]),
        rays.directions.new_tensor([1.0, 0.0, 0.0]),
    )
    first = normalize(torch.linalg.cross(rays.directions, helper, dim=1), dim=1)
    second = torch.linalg.cross(rays.directions, first, dim=1)
    angle = rays.radius.clamp_min(LEAST_TURN)[:, None]
    points = []
    for side in (first, second):
        turned = replace(rays, directions=normalize(rays.directions + angle * side, dim=1))
        turned = turned.within(torch.zeros_like(rays.near), torch.full_like(rays.far, torch.inf))
        points.append(turned.origins + distance_along(turned)[:, None] * turned.directions)
    surface = rays.origins + distance[:, None] * rays.directions
    normal = normalize(torch.linalg.cross(points[0] - surface, points[1] - surface, dim=1), dim=1)
    towards = (normal * rays.directions).sum(dim=1, keepdim=True)
    normal = torch.where(towards > 0, -normal, normal)
    return torch.where(normal.norm(dim=1, keepdim=True) > 0.5, normal, -rays.directions)
