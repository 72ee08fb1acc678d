"""Photographs taken from one place: pairs whose matches a rotation of the camera alone explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.photos.consistency import MATCHES, NEAR
from invgraphics.scenes.photos.pairs import MatchedPair, VerifiedMatches
from invgraphics.scenes.photos.prepare import Prepared

GUESSES = tuple(np.geomspace(0.6, 1.4, 13))
"""Focal lengths over the longest side that are tried where none is known: 22 to 50 mm of film. Longer ones would explain
photographs of a wall along which the camera was moved: a narrow view hardly tells this from a turn."""

TURNED = 0.9
"""Share of a pair's matches from which a rotation explains it. Measured: 1.00 in the 15 pairs of a camera turned by 4° at a
time; 0.25 to 0.48 in 10 pairs of a walk around a box; widest pairs of `fox`, `bonsai` and `colmap_statue` 0.05 to 0.70."""

_SAMPLES = 64


def is_panorama(photos: Sequence[Prepared], evidence: VerifiedMatches) -> bool:
    """Whether rotations explain the widest pair of the median photograph; pairs of few matches do not count."""
    shares = [
        rotation_share(pair, photos[pair.first], photos[pair.second]) for pair in widest_pairs(evidence, MATCHES).values()
    ]
    return bool(shares) and float(np.median(shares)) >= TURNED


def widest_pairs(evidence: VerifiedMatches, least: int = 1) -> dict[int, MatchedPair]:
    """Of each photograph the pair of largest motion: neighbours in a film have moved next to nothing.

    Args:
        evidence: verified pairs.
        least: fewest matches of a pair that counts.
    """
    widest: dict[int, MatchedPair] = {}
    for pair in evidence.pairs:
        for index in (pair.first, pair.second) if len(pair) >= least else ():
            if index not in widest or pair.motion > widest[index].motion:
                widest[index] = pair
    return widest


def rotation_share(pair: MatchedPair, first: Prepared, second: Prepared) -> float:
    """Largest share of a pair's matches that one rotation moves to within `NEAR` pixels.

    RANSAC over rotations that two matches determine, with a fixed seed; lens distortion is left out of account.
    """
    best = 0.0
    for guess in GUESSES if first.focal is None or second.focal is None else (1.0,):
        focals = [photo.focal or guess * max(photo.width, photo.height) for photo in (first, second)]
        rays = [_rays(points, photo, focal) for points, photo, focal in zip(pair.points, (first, second), focals, strict=True)]
        drawn = np.random.default_rng(0).integers(len(pair), size=(_SAMPLES, 2))
        turned = rays[0] @ _rotations(rays[0][drawn], rays[1][drawn]).transpose(0, 2, 1)
        angles = np.arccos((turned * rays[1]).sum(axis=-1).clip(-1, 1))
        best = max(best, float((angles * focals[1] < NEAR).mean(axis=1).max()))
    return best


def _rays(points: Float[np.ndarray, "m 2"], photo: Prepared, focal: float) -> Float[np.ndarray, "m 3"]:
    """Unit directions of image points in the camera's frame."""
    centre = photo.centre or (photo.width / 2, photo.height / 2)
    rays = np.column_stack([(points - np.asarray(centre)) / focal, np.ones(len(points))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _rotations(first: Float[np.ndarray, "s 2 3"], second: Float[np.ndarray, "s 2 3"]) -> Float[np.ndarray, "s 3 3"]:
    """Rotations that map pairs of directions to others with the least squared error (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(second.transpose(0, 2, 1) @ first)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt
