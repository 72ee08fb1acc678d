"""Where fits start: points and scales of Gaussians, and the spheres of signed distances, solid or hollow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from invgraphics.core.bounds import Bounds
from invgraphics.core.colour import srgb_to_linear
from invgraphics.core.scene import Points, Scene, View
from invgraphics.errors import InputError
from invgraphics.fields.points.stereo import stereo_points

NEIGHBOURS = 3
"""A Gaussian starts as wide as the mean distance to this many nearest neighbours (3DGS, §5.1)."""
FAR_SHARE = 0.2
"""Share of random points that goes outside the inner box of a contracted space."""
FAR_REACH = 30.0
"""How far out those go, in half-extents of the box; log-uniformly, so that every shell gets its share."""
BACKDROP_REACH = (1.5, 10.0)
"""How far from its camera a backdrop's point lies, over the distance of the subject; log-uniformly."""
LEAST_MATCHED = 500
"""Points that stereo must find for a start from them: fewer are chance."""
SCALE_RANGE = (1e-5, 0.5)
"""Limits of a starting scale, relative to the scene's radius (or to the distance from its centre, where that is larger)."""
SOLID = 0.5
"""Radius of the solid sphere that a signed distance starts as, in the box's smallest half-extent (NeuS)."""
ENDLESS = 1.5
"""Radius of the hollow sphere (MonoSDF) in endless space, in half-extents of contracted space, which ends at 2; tried on one
made-up room of photographs, as was 1, on whose sphere the farthest cameras stand and with which nothing is learnt."""


def starting_scales(positions: Float[Tensor, "n 3"], bounds: Bounds) -> Float[Tensor, " n"]:
    """Initial scales: mean distance to the nearest neighbours, clamped to `SCALE_RANGE`."""
    from scipy.spatial import KDTree

    reach = (positions - bounds.centre).norm(dim=1).clamp_min(bounds.radius)
    if len(positions) == 1:
        return SCALE_RANGE[1] * reach
    neighbours = min(NEIGHBOURS, len(positions) - 1)
    points = positions.detach().double().cpu().numpy()
    distances, _ = KDTree(points).query(points, k=neighbours + 1)
    mean = torch.from_numpy(distances[:, 1:]).mean(dim=1).to(positions)
    return mean.clamp(SCALE_RANGE[0] * reach, SCALE_RANGE[1] * reach)


def median_spacing(positions: Float[Tensor, "n 3"], rank: int, bounds: Bounds) -> float:
    """Median distance of a point to its neighbour of a rank, or to the farthest of fewer; of one point, the scene's radius."""
    from scipy.spatial import KDTree

    if len(positions) == 1:
        return SCALE_RANGE[1] * bounds.radius
    points = positions.detach().double().cpu().numpy()
    distances, _ = KDTree(points).query(points, k=min(rank, len(points) - 1) + 1)
    return max(float(np.median(distances[:, -1])), SCALE_RANGE[0] * bounds.radius)


def random_points(bounds: Bounds, count: int) -> Points:
    """Draw uniform points of random colour in the box, in a contracted space some of them on distant shells."""
    x = torch.rand(count, 3) * 2 - 1
    if bounds.space == "contracted":
        far = round(FAR_SHARE * count)
        shell = nn.functional.normalize(torch.randn(far, 3), dim=1)
        x[:far] = shell * FAR_REACH ** torch.rand(far, 1)
    return Points(bounds.centre + x * bounds.half, torch.rand(count, 3))


def scene_points(scene: Scene, most: int) -> Points:
    """Draw up to ``most`` of the scene's points, with colours in the scene's colour space.

    Raises:
        InputError: the point cloud is empty or not finite.
    """
    assert scene.points is not None
    points = _subset(_checked(scene.points, scene.name), most)
    return replace(points, rgb=srgb_to_linear(points.rgb)) if scene.colour == "linear" else points


def backdrop_points(scene: Scene, count: int) -> Points:
    """Draw ``count`` background points behind the subject, on rays of random training pixels, with their colours.

    Structure from motion finds points of the subject and few behind it. Without Gaussians there, photographs are explained
    by floaters in front of it instead, which other views do not share. There are none in a box, which holds all there is, nor
    where photographs are transparent: emptiness is known to be behind the subject then.

    Args:
        scene: with its training views; the subject is at the centre of its bounds.
        count: how many, evenly over the views.
    """
    if scene.bounds.space == "box" or scene.has_alpha:
        count = 0
    views, (least, most) = scene.train, BACKDROP_REACH
    shares = [count // len(views) + (index < count % len(views)) for index in range(len(views))]
    positions, colours = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for view, share in zip(views, shares, strict=True):
        flat = view.valid().reshape(-1).nonzero()[:, 0]
        flat = flat[torch.randperm(len(flat))[:share]]
        rays = view.camera.rays(view.camera.pixel_centres_of(flat))
        subject = max(float((view.camera.position - scene.bounds.centre).norm()), scene.bounds.radius)
        distance = subject * least * (most / least) ** torch.rand(len(flat), 1)
        positions.append(rays.origins + distance * rays.directions)
        colours.append(view.colour(flat))
    return Points(torch.cat(positions), torch.cat(colours))


def depth_points(scene: Scene, most: int) -> Points:
    """Draw up to ``most`` surface points from the training views' depth maps, evenly over views, pixels at random.

    Raises:
        InputError: no training view has a depth map, or they show nothing.
    """
    views = [view for view in scene.train if view.depth is not None and bool(_hits(view.depth).any())]
    if not views:
        remedy = "Set field.init = 'scene' or 'random'."
        raise InputError(f"The training views of scene '{scene.name}' have no depth maps to start from.", remedy)
    shares = [most // len(views) + (i < most % len(views)) for i in range(len(views))]
    parts = [_seen_points(view, share) for view, share in zip(views, shares, strict=True)]
    return Points(torch.cat([part.position for part in parts]), torch.cat([part.rgb for part in parts]))


def _hits(depth: Float[Tensor, "*p"]) -> Bool[Tensor, "*p"]:
    """Where a depth map shows a surface; depth cameras write 0 where they have measured nothing."""
    return torch.isfinite(depth) & (depth > 0)


def _seen_points(view: View, most: int) -> Points:
    """Unproject a view's depth map to points; pixels without a hit and masked-out ones are skipped."""
    assert view.depth is not None
    depth = view.depth.reshape(-1)
    flat = (_hits(depth) & view.valid().reshape(-1)).nonzero()[:, 0]
    flat = flat[torch.randperm(len(flat))[:most]]
    rays = view.camera.rays(view.camera.pixel_centres_of(flat))
    return Points(rays.origins + depth[flat, None] * rays.directions, view.colour(flat))


def _checked(points: Points, scene: str) -> Points:
    if len(points) == 0:
        remedy = "Set the field's init = 'random', or give the scene points."
        raise InputError(f"The point cloud of scene '{scene}' is empty, so there is nothing to start from.", remedy)
    for name in ("position", "rgb"):
        bad = int((~torch.isfinite(getattr(points, name))).any(dim=1).sum())
        if bad:
            remedy = "Remove them, or set the field's init = 'random'."
            raise InputError(f"The point cloud of scene '{scene}': {bad} points have a {name} that is not finite.", remedy)
    return points


def _subset(points: Points, most: int) -> Points:
    if len(points) <= most:
        return points
    return points[torch.randperm(len(points))[:most]]


def initial_points(scene: Scene, init: str, count: int, most: int) -> Points:
    """Points of ``scene`` to place primitives on.

    Args:
        scene: what is to be fitted.
        init: ``depth`` for the training views' depth maps, ``scene`` for its own points where it has some, ``stereo`` for those
            that its photographs show or, if these are fewer than `LEAST_MATCHED`, as ``scene``; else random ones.
        count: number of random points.
        most: largest number of the others.

    Raises:
        InputError: the scene's point cloud is empty or not finite, or there are no depth maps.
    """
    if init == "depth":
        return depth_points(scene, most)
    if init == "stereo" and len(matched := stereo_points(scene, most)) >= min(LEAST_MATCHED, most):
        return matched
    known = init in ("scene", "stereo") and scene.points is not None
    return scene_points(scene, most) if known else random_points(scene.bounds, count)


def hollow_radius(scene: Scene) -> float | None:
    """Radius in local units of the hollow sphere that a signed distance starts as around a scene's cameras.

    In a box its smallest half-extent, also where some cameras are farther out: on `room` a sphere that holds all of them ends
    1.5 and 4.9 dB lower (64 px, 500 steps of NeuS on a hash grid, two seeds). ``None`` for a solid sphere, for other scenes.
    """
    if not scene.is_interior:
        return None
    return float(scene.bounds.half.min()) * (ENDLESS if scene.bounds.space == "contracted" else 1.0)
