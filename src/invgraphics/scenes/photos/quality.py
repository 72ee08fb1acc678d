"""Figures of a reconstruction, and why photographs were not registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from invgraphics.scenes.photos.outlier_cameras import FEW_POINTS
from invgraphics.scenes.photos.pairs import VerifiedMatches
from invgraphics.scenes.photos.panorama import is_panorama, widest_pairs
from invgraphics.scenes.photos.prepare import ADVICE, LEAST, Prepared

SHARE = 0.5
"""A scene is usable when at least `LEAST` photographs, and this share of them, could be placed."""

FEW_FEATURES = 200
"""A sharp photograph of a textured scene has thousands of SIFT features; below this one there is little to hold on to."""

NO_MOTION = 0.01
"""Motion of matches, as a share of the longest side, below which a pair shows no parallax worth the name."""


def describe(model: Any, photos: Sequence[Prepared]) -> dict[str, Any]:
    """Figures of a reconstruction (before its lens is removed): counts, errors in pixels, cameras and lenses.

    Cameras are those of the upright working copies, with their size and the EXIF orientation by which they were turned.
    """
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    cameras = []
    for photo in photos:
        if photo.name in placed:
            image = placed[photo.name]
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().inverse().matrix()
            entry = {"name": photo.name, "source": photo.source, "points": image.num_points3D, "cam_to_world": pose.tolist()}
            cameras.append(entry | {"size": [photo.width, photo.height], "orientation": photo.orientation})
    return {
        "registered": len(cameras),
        "points": model.num_points3D(),
        "reprojection_error_px": float(model.compute_mean_reprojection_error()),
        "track_length": float(model.compute_mean_track_length()),
        "observations_per_photo": float(model.compute_mean_observations_per_reg_image()),
        "lenses": [
            {"model": camera.model_name, "params": list(map(float, camera.params)), "size": [camera.width, camera.height]}
            for camera in model.cameras.values()
        ],
        "cameras": cameras,
    }


EMPTY_FIGURES: dict[str, Any] = {
    "registered": 0, "points": 0, "reprojection_error_px": None, "track_length": None, "observations_per_photo": None,
    "lenses": [], "cameras": [],
}  # fmt: skip
"""`describe` where no two photographs could be placed."""


def unplaced(
    photos: Sequence[Prepared],
    evidence: VerifiedMatches,
    placed: set[str],
    outliers: Mapping[str, str],
    pieces: Sequence[Any] = (),
) -> dict[str, str]:
    """Photograph -> why it has no pose.

    Args:
        photos: all of them.
        evidence: their matches.
        placed: names of those with a pose.
        outliers: photograph -> why its camera was removed.
        pieces: other reconstructions, apart from the one that is kept.
    """
    elsewhere = {image.name: model.num_reg_images() for model in pieces for image in model.images.values() if image.has_pose}
    reasons = {}
    for index, photo in enumerate(photos):
        if photo.name in placed:
            continue
        features, partners = evidence.features[index], evidence.partners(index)
        if photo.source in outliers:
            reasons[photo.source] = outliers[photo.source]
        elif features < FEW_FEATURES:
            reasons[photo.source] = f"only {features} features: blurred, or it shows something bare"
        elif photo.name in elsewhere:
            piece = f"in a separate piece of {elsewhere[photo.name]} photographs, which shares too few matches with this one"
            reasons[photo.source] = f"{piece}; --matching exhaustive, or photographs between the two, may join them"
        elif not partners:
            reasons[photo.source] = "shares nothing with any other photograph"
        else:
            reasons[photo.source] = f"its matches with {partners} others do not fit the rest"
    return reasons


def is_usable(registered: int, count: int) -> bool:
    """Whether a scene with ``registered`` of ``count`` photographs is usable."""
    return registered >= max(LEAST, SHARE * count)


def placeable(evidence: VerifiedMatches) -> int:
    """Photographs that may be placed: those with enough features, and verified matches with another."""
    matched = {index for pair in evidence.pairs for index in (pair.first, pair.second)}
    return sum(evidence.features[index] >= FEW_FEATURES for index in matched)


def registration_obstacle(photos: Sequence[Prepared], evidence: VerifiedMatches) -> tuple[str, str] | None:
    """Why no strategy can register these photographs, and a remedy; ``None`` where one may."""
    longest = max(max(photo.width, photo.height) for photo in photos)
    features = float(np.median(evidence.features))
    motions = [pair.motion for pair in widest_pairs(evidence).values()]
    if features < FEW_FEATURES:
        remedy = "Take sharp photographs of something with texture, in better light; or give a larger --max-size."
        return f"they show too little to recognise ({features:.0f} features each, blurred or bare).", remedy
    remedy = "Step sideways between photographs: depth cannot be seen from one place."
    if motions and float(np.median(motions)) < NO_MOTION * longest:
        return "they are taken from one and the same place.", remedy
    if is_panorama(photos, evidence):
        return "they are taken from one place: turns of the camera alone explain their matches.", remedy
    if len(evidence.pairs) < len(photos) - 1:
        return f"they hardly overlap ({len(evidence.pairs)} pairs of them show a common part).", ADVICE
    return None


def refusal(photos: Sequence[Prepared], evidence: VerifiedMatches, observed: Sequence[int]) -> tuple[str, str] | None:
    """Why a reconstruction is not usable, and a remedy; ``None`` where it is.

    Args:
        photos: all of them.
        evidence: their matches.
        observed: how many points each registered photograph observes.
    """
    registered, points = len(observed), float(np.median(observed)) if observed else 0.0
    enough = is_usable(registered, len(photos))
    if enough and points >= FEW_POINTS:
        return None
    what = f"Only {registered} of {len(photos)} photographs could be placed" if registered else "No photograph could be placed"
    if enough:
        what = f"{registered} of {len(photos)} photographs were placed by next to nothing ({points:.0f} points in the median)"
    remedy = "Try --lens fisheye or --matching exhaustive; or take more photographs between those there are."
    why, remedy = registration_obstacle(photos, evidence) or ("their matches do not fit together.", remedy)
    return f"{what}: {why}", remedy
