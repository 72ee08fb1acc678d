"""Noise-free truth: one ray per pixel centre, cast by our own `Camera`, so that depth is measured from its centre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch.nn.functional import grid_sample

from invgraphics.core import Camera
from invgraphics.scenes.mitsuba.build.model import Fog

FOG_STEPS = 256
RAYS_AT_ONCE = 2**14


@dataclass(frozen=True)
class GBuffer:
    """First hits of a view.

    Attributes:
        depth: distance along the unit ray, inf where nothing is hit.
        normal: geometric normal in world axes, facing the camera; zero where nothing is hit.
        alpha: 1 where a surface is hit; for fog, one minus the transmittance.
        position: the hits, zero where there is none.
    """

    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    position: Float[np.ndarray, "h w 3"]


def trace(scene: Any, camera: Camera) -> GBuffer:
    """First hits with the surfaces of a loaded Mitsuba scene."""
    rays = camera.rays()
    origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy()
    distance, normal = first_hits(scene, origins, directions)
    hit = np.isfinite(distance)
    away = (normal * directions).sum(axis=1) > 0
    normal = np.where(hit[:, None], np.where(away[:, None], -normal, normal), 0.0)
    position = np.where(hit[:, None], origins + np.where(hit, distance, 0.0)[:, None] * directions, 0.0)
    shape = (camera.height, camera.width)
    return GBuffer(
        distance.reshape(shape).astype(np.float32),
        normal.reshape(*shape, 3).astype(np.float32),
        hit.reshape(shape).astype(np.float32),
        position.reshape(*shape, 3).astype(np.float32),
    )


def trace_fog(fog: Fog, camera: Camera) -> GBuffer:
    """Coverage of a medium without surfaces: alpha = 1 - exp(-integral of the extinction), by the midpoint rule."""
    rays = camera.rays()
    grid = torch.from_numpy(np.ascontiguousarray(fog.extinction.transpose(2, 1, 0))).double()[None, None]
    lo, hi = torch.tensor(fog.lo).double(), torch.tensor(fog.hi).double()
    alphas = []
    for origin, direction in zip(
        rays.origins.double().split(RAYS_AT_ONCE), rays.directions.double().split(RAYS_AT_ONCE), strict=True
    ):
        slabs = torch.stack([(lo - origin) / direction, (hi - origin) / direction])
        near = slabs.amin(0).amax(1).clamp_min(0)
        length = (slabs.amax(0).amin(1) - near).clamp_min(0)
        middles = (torch.arange(FOG_STEPS).double() + 0.5) / FOG_STEPS
        along = near[:, None] + length[:, None] * middles
        unit = (origin[:, None] + along[..., None] * direction[:, None] - lo) / (hi - lo)
        # Cell centres at (i + 0.5) / n and the border repeated: Mitsuba's convention for grids as well.
        values = grid_sample(grid, (2 * unit - 1)[None, None], padding_mode="border", align_corners=False)
        alphas.append(1 - torch.exp(-values[0, 0, 0].mean(dim=1) * length))
    shape = (camera.height, camera.width)
    alpha = torch.cat(alphas).reshape(shape).float().numpy()
    zero = np.zeros((*shape, 3), np.float32)
    return GBuffer(np.full(shape, np.inf, np.float32), zero, alpha, zero)


def first_hits(
    scene: Any, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Distance (inf where there is none) and geometric normal of each ray's first hit."""
    import mitsuba

    if str(mitsuba.variant()).startswith("scalar"):
        hits = [
            scene.ray_intersect(mitsuba.Ray3f(mitsuba.Point3f(o), mitsuba.Vector3f(d)))
            for o, d in zip(origins, directions, strict=True)
        ]
        distance = np.array([hit.t if hit.is_valid() else np.inf for hit in hits])
        return distance, np.array([np.array(hit.n).reshape(3) for hit in hits])
    hit = scene.ray_intersect(mitsuba.Ray3f(mitsuba.Point3f(origins.T), mitsuba.Vector3f(directions.T)))
    valid = np.array(hit.is_valid())
    return np.where(valid, np.array(hit.t, dtype=np.float64), np.inf), np.array(hit.n, dtype=np.float64).T


def sample_points(counts: Sequence[int], most: int, seed: int) -> list[tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]]:
    """Choose at most ``most`` of the surface points that views see, without repetition.

    Args:
        counts: points of each view.
        most: how many in all.
        seed: of the choice.

    Returns:
        For each view the places of its points among the chosen ones, and their numbers in the view.
    """
    chosen: Int[np.ndarray, " p"] = np.random.default_rng(seed).permutation(sum(counts))[:most]
    ends = np.cumsum(counts)
    view = np.searchsorted(ends, chosen, side="right")
    places = [np.flatnonzero(view == index) for index in range(len(counts))]
    return [(place, chosen[place] - (ends[index] - counts[index])) for index, place in enumerate(places)]
