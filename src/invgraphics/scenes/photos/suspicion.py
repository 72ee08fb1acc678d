"""A check on reconstructions that are complete, precise and wrong: do pairs of photographs agree with the whole?

Where a scene looks alike in different places, structure from motion can fold it: every photograph is placed, the reprojection
error is small (what contradicts is dropped as an outlier), and cameras stand on the wrong side. But each pair of photographs is
matched and verified on its own, before any reconstruction: pairs whose many verified matches lie off the epipolar lines
of the reconstructed poses are witnesses against it. Only the best matched quarter of the pairs is heard: real scenes hold a few
things twice, and pairs that mistake one for the other are verified, yet they are weak unless the whole scene repeats.
Comparing rotations of two-view geometries with the reconstruction, or going around triplets of them, tells less: small planar
overlaps leave the rotation of honest pairs ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.photos.pairs import Evidence, Pair
from invgraphics.scenes.photos.prepare import Prepared

MATCHES = 30
"""Pairs with fewer verified matches are no witnesses: chance can bring so many onto one geometry."""

STRONG = 0.75
"""Quantile of the numbers of matches from which a pair is heard."""

NEAR = 4.0
"""Pixels from its epipolar line at which a match still counts as explained: the tolerance of COLMAP's verification."""

EXPLAINED = 0.5
"""A pair of which the poses explain a smaller share of the matches contradicts them."""

SUSPICIOUS = 0.03
"""Share of contradicting pairs from which a reconstruction is suspicious.

Measured: none where the poses were right (a textured scene, a box with unique pictures, and fifty photographs of a room, 19 %
of whose verified pairs are wrong); 7 and 13 % where a box with the same picture on all its sides was folded."""


def examine(model: Any, photos: Sequence[Prepared], evidence: Evidence) -> dict[str, Any]:
    """Count the pairs of placed photographs that contradict the poses.

    Args:
        model: a ``pycolmap.Reconstruction``, its lenses not removed yet.
        photos: as the indices in ``evidence`` count them.
        evidence: verified matches.

    Returns:
        ``pairs`` that were heard, ``contradicting`` ones, their ``share``, ``suspicious``, a ``sentence`` for a person, and the
        ``worst`` pairs.
    """
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    asked: list[tuple[float, Pair]] = []
    for pair in evidence.pairs:
        first, second = (placed.get(photos[index].name) for index in (pair.first, pair.second))
        if len(pair) >= MATCHES and first is not None and second is not None:
            asked.append((explained(first, second, pair), pair))
    enough = np.quantile([len(pair) for _, pair in asked], STRONG, method="lower") if asked else 0
    asked = [(share, pair) for share, pair in asked if len(pair) >= enough]
    contradicting = sorted((share, pair.first, pair.second, len(pair)) for share, pair in asked if share < EXPLAINED)
    worst = [
        {"photos": [photos[first].source, photos[second].source], "matches": matches, "explained": share}
        for share, first, second, matches in sorted(contradicting, key=lambda row: -row[3])[:5]
    ]
    share = len(contradicting) / len(asked) if asked else 0.0
    return {
        "pairs": len(asked),
        "contradicting": len(contradicting),
        "share": share,
        "threshold": SUSPICIOUS,
        "suspicious": share >= SUSPICIOUS,
        "sentence": _sentence(share, len(contradicting), len(asked), worst),
        "worst": worst,
    }


def _sentence(share: float, contradicting: int, asked: int, worst: Sequence[dict[str, Any]]) -> str:
    if share < SUSPICIOUS:
        return f"{contradicting} of the {asked} best matched pairs of photographs contradict the poses"
    first, second = worst[0]["photos"]
    return (
        f"{contradicting} of the {asked} best matched pairs of photographs contradict the poses ({100 * share:.0f} %), such as "
        f"{first} and {second}: parts that look alike may have been taken for one. Look at top-view.png; photographs that show "
        "more of the surroundings, or leaving out those that show repeated parts alone, help."
    )


def explained(first: Any, second: Any, pair: Pair) -> float:
    """Share of a pair's matches that lie within `NEAR` pixels of the epipolar lines of two posed ``pycolmap.Image``.

    The distance is Sampson's, in pixels of the first photograph; lenses are taken into account.
    """
    relative = second.cam_from_world() * first.cam_from_world().inverse()
    matrix = np.asarray(relative.matrix())
    planes = [_plane(image, points) for image, points in zip((first, second), pair.points, strict=True)]
    distance = sampson(matrix[:, :3], matrix[:, 3], planes[0], planes[1])
    return float(np.mean(distance * first.camera.mean_focal_length() < NEAR))


def sampson(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, 3], first: Float[np.ndarray, "m 2"], second: np.ndarray
) -> Float[np.ndarray, " m"]:
    """First-order distance of matches from the epipolar geometry (Hartley & Zisserman 2004, eq. 11.9), on the planes z = 1.

    Args:
        rotation: from the first camera's frame to the second's.
        translation: likewise; its length does not matter.
        first: places in the first picture.
        second: places in the second.
    """
    x, y, z = translation / (np.linalg.norm(translation) or 1.0)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    first, second = (np.column_stack([plane, np.ones(len(plane))]) for plane in (first, second))
    line_2, line_1 = first @ essential.T, second @ essential
    squares = line_2[:, 0] ** 2 + line_2[:, 1] ** 2 + line_1[:, 0] ** 2 + line_1[:, 1] ** 2
    return np.abs((second * line_2).sum(axis=1)) / np.sqrt(np.maximum(squares, 1e-30))


def _plane(image: Any, points: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    return np.asarray(image.camera.cam_from_img(points.astype(np.float64)))
