"""Surface points from photographs by multi-view stereo: plane sweeps (Collins 1996), kept where depth maps agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.planes import homographies_to, warp
from invgraphics.core.scene import Points, Scene, View
from invgraphics.fields.plane_sweep import premultiplied

MOST_VIEWS = 32
"""Training views that get a depth map, evenly spaced; others are only matched with."""
MOST_PIXELS = 160 * 160
"""Pixels of a picture that is matched; larger ones are averaged."""
PLANES = 64
"""Of a sweep; depths between them are those of the parabola through the three costs."""
NEIGHBOURS = 4
"""Views that each view is matched with."""
BEST = 2
"""Of them, so many count at a pixel, those that match best: others may not see its surface."""
WINDOW = 5
"""Pixels along the edge of the window whose colours are compared."""
IDEAL_PARALLAX, NARROWER, WIDER, WIDEST = 5.0, 1.0, 10.0, 60.0
"""Degrees between views that match best, scores' widths below and above (MVSNet, Yao et al. 2018, §4.1), and the most."""
TOLERANCE = 1.5
"""Depths agree that differ by at most so many planes."""
LEAST_CONSISTENT = 2
"""Other depth maps that must agree with a point."""
MIN_ALPHA = 0.5
NEAREST, FARTHEST = 0.05, 20.0
"""Range of depths in a space without an end, relative to the camera's distance from its centre."""


@dataclass(frozen=True)
class _Picture:
    """A training view at the size that is matched."""

    camera: Camera
    layers: Float[Tensor, "4 h w"]  # colour times alpha, and alpha
    solid: Bool[Tensor, "h w"]
    planes: Float[Tensor, " p"]  # depths along the optical axis, evenly spaced in their inverse

    @property
    def spacing(self) -> float:
        """Difference of two planes' inverse depths."""
        return float(1 / self.planes[0] - 1 / self.planes[-1]) / (PLANES - 1)


@torch.no_grad()
def stereo_points(scene: Scene, most: int) -> Points:
    """Points on the surfaces that the training views show, from their colours and poses alone.

    Each view is swept with planes through the neighbours that match best; a pixel's depth is that at which windows around it
    differ least. Points are kept where the depth maps of other views agree, so that views which nothing else sees, mirrors and
    flat colours give none. Randomness comes from torch's global generator.

    Args:
        scene: with two training views at least, or there is nothing to match.
        most: a random subset if there are more.

    Returns:
        Positions, and the colours of their pixels in the scene's colour space; none where nothing matches.
    """
    pictures = [_shrunk(view, scene.bounds) for view in scene.train]
    count = min(MOST_VIEWS, len(pictures))
    chosen = [index * len(pictures) // count for index in range(count)]
    parallax = _parallax([picture.camera for picture in pictures], scene.bounds)
    depths = {
        index: _depth_map(pictures, index, _matching_views(parallax[index], range(len(pictures)), NEIGHBOURS))
        for index in chosen
    }
    parts = [
        _consistent_points(pictures, index, depths, _matching_views(parallax[index], chosen, 2 * NEIGHBOURS))
        for index in chosen
    ]
    position, rgb = (torch.cat([getattr(part, name) for part in parts]) for name in ("position", "rgb"))
    subset = torch.randperm(len(position))[:most]
    return Points(position[subset], rgb[subset])


def _shrunk(view: View, bounds: Bounds) -> _Picture:
    camera, alpha = view.camera, view.opacity()
    layers = premultiplied(view)
    counts = view.valid().to(alpha)
    shrink = math.sqrt(MOST_PIXELS / alpha.numel())
    if shrink < 1:
        size = max(1, round(camera.height * shrink)), max(1, round(camera.width * shrink))
        layers, counts = (interpolate(each[None], size, mode="area")[0] for each in (layers, counts[None]))
        camera, counts = camera.resized(size[1], size[0]), counts[0]
    distance = max(float((camera.position - bounds.centre).norm()), NEAREST * bounds.radius)
    if bounds.space == "box":
        near, far = max(distance - bounds.radius, NEAREST * distance), distance + bounds.radius
    else:
        near, far = max(bounds.near, NEAREST * distance), FARTHEST * max(distance, bounds.radius)
    planes = 1 / torch.linspace(1 / near, 1 / far, PLANES)
    return _Picture(camera, layers, (layers[3] >= MIN_ALPHA) & (counts >= MIN_ALPHA), planes)


def _parallax(cameras: Sequence[Camera], bounds: Bounds) -> Float[Tensor, "n n"]:
    """Degrees between views, seen from the scene's centre; infinite where they look away from one another, and of one view."""
    towards = torch.nn.functional.normalize(torch.stack([camera.position for camera in cameras]) - bounds.centre, dim=1)
    axes = torch.stack([camera.cam_to_world[:3, 2] for camera in cameras])
    degrees = (towards @ towards.T).clamp(-1, 1).acos().rad2deg()
    degrees[axes @ axes.T < math.cos(math.radians(WIDEST))] = torch.inf
    return degrees.fill_diagonal_(torch.inf)


def _matching_views(parallax: Float[Tensor, " n"], candidates: Sequence[int], count: int) -> list[int]:
    """Indices of at most ``count`` views to match a view with, best first."""
    among = torch.tensor(candidates)
    off = parallax[among] - IDEAL_PARALLAX
    cost = (off / torch.where(off < 0, NARROWER, WIDER)).square()
    order = cost.argsort(stable=True)[:count]
    return among[order[parallax[among[order]] <= WIDEST]].tolist()


def _depth_map(pictures: Sequence[_Picture], index: int, others: Sequence[int]) -> Float[Tensor, "h w"]:
    """Depth along the optical axis of each of a view's pixels, where ``others`` differ least; NaN where there is none."""
    here = pictures[index]
    if not others:
        return torch.full_like(here.layers[0], torch.nan)
    costs = []
    for other in others:
        maps = homographies_to(here.camera, here.planes, pictures[other].camera)
        layers = pictures[other].layers.expand(PLANES, -1, -1, -1)
        seen, inside, _ = warp(layers, maps, (here.camera.width, here.camera.height))
        difference = torch.where(inside > 0, (seen - here.layers).abs().mean(dim=1), 1.0)
        costs.append(avg_pool2d(difference, WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False))
    cost = torch.stack(costs).sort(dim=0).values[:BEST].mean(dim=0)
    best = cost.argmin(dim=0)
    inner = (best > 0) & (best < PLANES - 1)
    before, at, after = (cost.gather(0, (best.clamp(1, PLANES - 2) + step)[None])[0] for step in (-1, 0, 1))
    shift = (before - after) / (2 * (before - 2 * at + after)).clamp_min(1e-9)
    depth = 1 / (1 / here.planes[0] - (best + shift.clamp(-0.5, 0.5)) * here.spacing)
    return torch.where(here.solid & inner, depth, torch.nan)


def _consistent_points(pictures: Sequence[_Picture], index: int, depths: dict[int, Tensor], others: Sequence[int]) -> Points:
    """Geometric consistency: points of a view's depth map that `LEAST_CONSISTENT` of the others show too (one of only one)."""
    here, depth = pictures[index], depths[index].flatten()
    flat = torch.isfinite(depth).nonzero()[:, 0]
    rays = here.camera.rays(here.camera.pixel_centres_of(flat))
    along = (rays.directions @ here.camera.cam_to_world[:3, 2]).abs()
    position = rays.origins + (depth[flat] / along)[:, None] * rays.directions
    votes = torch.zeros(len(flat))
    for other in others:
        there = pictures[other]
        pixel, distance = there.camera.project(position)
        grid = 2 * pixel / torch.tensor([there.camera.width, there.camera.height]) - 1
        seen = grid_sample(depths[other][None, None], grid[None, None], mode="nearest", align_corners=False)[0, 0, 0]
        agrees = (1 / distance - 1 / seen).abs() <= TOLERANCE * there.spacing
        votes += agrees & (distance > 0) & (grid.abs() <= 1).all(dim=1)
    kept = votes >= max(1, min(LEAST_CONSISTENT, len(others)))
    rgb = here.layers[:3].flatten(1).T[flat[kept]] / here.layers[3].flatten()[flat[kept], None]
    return Points(position[kept], rgb)
