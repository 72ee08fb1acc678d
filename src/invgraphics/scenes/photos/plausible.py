"""Plausibility of a reconstruction's cameras: focal length, distortion, baseline over depth, and observed points."""

from __future__ import annotations

from typing import Any

import numpy as np

from invgraphics.scenes.photos.outlier_cameras import FEW_POINTS
from invgraphics.scenes.photos.sources import FOCAL_RANGE

LEAST_SPREAD = 0.01
"""Extent of the cameras over the median depth of the points; below it, parallax is a hundredth of the focal length at most."""

_RADII = 64


def spread(model: Any) -> float:
    """Diagonal of the cameras' bounding box over the median distance from points to the cameras that observe them."""
    images = [image for image in model.images.values() if image.has_pose]
    centres = {image.image_id: np.asarray(image.projection_center()) for image in images}
    distances = [
        float(np.linalg.norm(point.xyz - centres[point.track.elements[0].image_id])) for point in model.points3D.values()
    ]
    if not distances or len(images) < 2:
        return 0.0
    extent = float(np.linalg.norm(np.ptp(np.array(list(centres.values())), axis=0)))
    return extent / max(float(np.median(distances)), 1e-12)


def implausible_parameters(model: Any) -> list[str]:
    """Implausible focal lengths, distortions, baselines and counts of points, in words; empty where there are none."""
    reasons: dict[str, None] = {}
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    for camera in (model.cameras[number] for number in sorted(used)):
        share = camera.mean_focal_length() / max(camera.width, camera.height)
        if not FOCAL_RANGE[0] < share < FOCAL_RANGE[1]:
            reasons[f"the focal length is {share:.2g} times the picture's longest side"] = None
        elif is_folded(camera):
            reasons["the lens distortion folds the picture over"] = None
    if model.num_points3D() and (ratio := spread(model)) < LEAST_SPREAD:
        reasons[f"the cameras stand within {100 * ratio:.1f} % of the scene's distance"] = None
    observed = [image.num_points3D for image in model.images.values() if image.has_pose]
    if model.num_points3D() and (median := float(np.median(observed))) < FEW_POINTS:
        reasons[f"a camera observes {median:.0f} points in the median"] = None
    return list(reasons)


def is_folded(camera: Any) -> bool:
    """Whether a perspective lens's distorted radius stops growing within the image, so that two directions share a pixel."""
    if "FISHEYE" in camera.model_name:
        return False
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]) - centre
    corner = corners[np.linalg.norm(corners, axis=1).argmax()] / (camera.focal_length_x, camera.focal_length_y)
    plane = np.linspace(0, 1, _RADII)[:, None] * corner
    image = camera.img_from_cam(np.column_stack([plane, np.ones(_RADII)]))
    return bool((np.diff(np.linalg.norm(np.asarray(image) - centre, axis=1)) <= 0).any())
