"""Outlier cameras of a reconstruction: few observations, far from all others, a distortion that cannot be corrected.

They are deregistered and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.photos.prepare import Prepared
from invgraphics.scenes.photos.result import STRAIGHT, lens_of, max_distortion
from invgraphics.scenes.pictures.lens import straightening_obstacle

FEW_POINTS = 15
"""Fewest observations of a camera that is kept: COLMAP accepts no pair of photographs with fewer verified matches. Where the
median camera has fewer, the reconstruction is suspicious and not usable."""

FAR = 10.0
"""`isolation` from which a camera is an outlier."""

SPREAD_SHARE = 0.05
"""Of the cameras' distances from their middle, to which distances of near-duplicates (bursts, frames of a film) are nothing: a
camera is not isolated for lying between clusters of these."""

MOST = 1 / 3
"""Largest share of the cameras that may be outliers: beyond, the whole reconstruction is weak, and stays as it is."""

_QUANTILE = 0.9


def remove_outlier_cameras(model: Any, photos: Sequence[Prepared]) -> dict[str, str]:
    """Deregister the outlier cameras of a ``pycolmap.Reconstruction``.

    Returns:
        Photograph -> why its camera was removed.
    """
    source = {photo.name: photo.source for photo in photos}
    images = [image for image in model.images.values() if image.has_pose]
    centres = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    far = isolation(centres)
    reasons: dict[str, str] = {}
    frames = []
    for image, times in zip(images, far, strict=True):
        if image.num_points3D < FEW_POINTS:
            reasons[source[image.name]] = f"an outlier: it observes only {image.num_points3D} of the points"
        elif times > FAR:
            reasons[source[image.name]] = f"an outlier: {times:.0f} times as far from the other cameras as they are apart"
        else:
            continue
        frames.append(image.frame_id)
    if len(frames) > MOST * len(images):
        return {}
    for frame in frames:
        model.deregister_frame(frame)
    return reasons


def uncorrectable_cameras(model: Any) -> dict[int, str]:
    """Cameras with photographs whose lens distortion cannot be corrected -> why."""
    reasons = {}
    for number in sorted({image.camera_id for image in model.images.values() if image.has_pose}):
        lens = lens_of(model.cameras[number])
        if max_distortion(lens) > STRAIGHT and (why := straightening_obstacle(lens)):
            reasons[number] = why.rstrip(".")
    return reasons


def remove_uncorrectable_cameras(model: Any, photos: Sequence[Prepared]) -> dict[str, str]:
    """Deregister the photographs of a ``pycolmap.Reconstruction`` whose distortion cannot be corrected.

    Returns:
        Photograph -> why it was removed.
    """
    source = {photo.name: photo.source for photo in photos}
    reason = uncorrectable_cameras(model)
    images = [image for image in model.images.values() if image.has_pose and image.camera_id in reason]
    reasons = {source[image.name]: f"no straight picture can be made of it: {reason[image.camera_id]}" for image in images}
    for frame in {image.frame_id for image in images}:
        model.deregister_frame(frame)
    return reasons


def isolation(centres: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of each camera to its nearest neighbour, in units of the 90 % quantile of these distances.

    The unit is at least `SPREAD_SHARE` of the 90 % quantile of the cameras' distances from their median position.
    """
    if len(centres) < 3:
        return np.zeros(len(centres))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    spread = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    usual, wide = (float(np.quantile(values, _QUANTILE, method="lower")) for values in (nearest, spread))
    return nearest / max(usual, SPREAD_SHARE * wide, 1e-12)
