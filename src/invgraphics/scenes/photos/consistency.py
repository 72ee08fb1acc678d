"""Consistency of a reconstruction with the two-view geometries: the check that finds folded and inverted ones.

Repeated structure or a misleading first pair can make structure from motion fold or invert a scene: every photograph is
registered, the reprojection error is small (contradicting matches are dropped as outliers), and cameras stand on the wrong
side. But each pair of photographs is matched and verified on its own, before any reconstruction. So a pair contradicts the
reconstruction if its verified matches lie off the epipolar lines of the reconstructed poses, or triangulate behind a camera.

Not all pairs count. Where a scene repeats itself, distant pairs that show different copies are verified too, with many matches
where the texture is rich. Of each photograph, the two pairs with most matches count, which on a walk are those with the
photographs before and after it: baselines are short there, and copies are hardly ever confused. One contradicting pair that is
among the strongest of both its photographs is enough: a fold needs no more. Comparing rotations of two-view geometries with
the reconstruction, or around triplets, is weaker evidence: small planar overlaps leave the rotation of correct pairs ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.photos.pairs import MatchedPair, VerifiedMatches
from invgraphics.scenes.photos.plausible import implausible_parameters, spread
from invgraphics.scenes.photos.prepare import Prepared

MATCHES = 30
"""Fewest verified matches of a pair that counts: chance can fit fewer to one geometry."""

PARTNERS = 2
"""Pairs that count for each photograph, those with most matches: one on either side of it on a walk.

Measured: no pair contradicts in four right reconstructions (bonsai by the global mapper, 84 pairs; fox by the incremental one,
33, 0.6° from the known poses; the box with unique pictures by both, 38). Of pairs that are each other's strongest, 1 to 6 of
17 to 42 contradict in eight wrong ones (bonsai by the incremental mapper; fox by the global one, 129° off; halves of the beer
can, whose two mappers and given poses differ by 50° and more; the box with the same picture on all its sides). With four
partners, bonsai's right poses have 4 of 158 against them; with the best matched quarter of all pairs, 15 of 169."""

NEAR = 4.0
"""Largest epipolar distance in pixels of a match that the poses explain: the tolerance of COLMAP's verification."""

EXPLAINED = 0.5
"""A pair of which the poses explain a smaller share of the matches contradicts them."""

AGREEING = 0.8
"""A photograph is doubtful if the poses explain a smaller share of its matches with its strongest partners."""

SUSPICIOUS = 0.1
"""Share of doubtful photographs from which a reconstruction is suspicious. Measured: none in the right ones above, 6 to 33 % in
the wrong ones."""


def check_consistency(model: Any, photos: Sequence[Prepared], evidence: VerifiedMatches) -> dict[str, Any]:
    """Count registered photographs whose strongest pairs contradict the poses, and check cameras for plausibility.

    Args:
        model: a ``pycolmap.Reconstruction``, its lenses not removed yet.
        photos: as the indices in ``evidence`` count them.
        evidence: verified matches.

    Returns:
        ``pairs`` that count, ``contradicting`` ones, their ``share``, how many of them are ``broken`` links between
        photographs that are each other's strongest partners; ``doubtful`` photographs of the ``asked`` ones, by name;
        ``support``, the share of all verified matches that the poses explain; ``spread`` of the cameras; ``implausible``
        properties; ``suspicious``, a ``sentence`` for a person, and the ``worst`` pairs.
    """
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    shares: dict[int, float] = {}
    for index, pair in enumerate(evidence.pairs):
        first, second = (placed.get(photos[photo].name) for photo in (pair.first, pair.second))
        if first is not None and second is not None:
            shares[index] = explained_share(first, second, pair)
    matches = sum(len(pair) for pair in evidence.pairs)
    partners = strongest(evidence.pairs, [index for index in shares if len(evidence.pairs[index]) >= MATCHES])
    counted = sorted({index for indices in partners.values() for index in indices})
    against = sorted((index for index in counted if shares[index] < EXPLAINED), key=lambda index: -len(evidence.pairs[index]))
    broken = [index for index in against if all(index in partners[photo] for photo in _ends(evidence.pairs[index]))]
    doubtful = [photo for photo, indices in sorted(partners.items()) if _agreement(indices, shares, evidence.pairs) < AGREEING]
    shown = [*broken, *(index for index in against if index not in broken)][:5]
    found = {
        "pairs": len(counted),
        "contradicting": len(against),
        "share": len(against) / len(counted) if counted else 0.0,
        "broken": len(broken),
        "asked": len(partners),
        "doubtful": [photos[photo].source for photo in doubtful],
        "threshold": SUSPICIOUS,
        "support": sum(share * len(evidence.pairs[index]) for index, share in shares.items()) / max(matches, 1),
        "spread": spread(model),
        "implausible": implausible_parameters(model),
        "worst": [_row(evidence.pairs[index], shares[index], photos) for index in shown],
    }
    suspicious = bool(broken or found["implausible"]) or 0 < len(doubtful) >= SUSPICIOUS * len(partners)
    return found | {"suspicious": suspicious, "sentence": _sentence(found, suspicious)}


def strongest(pairs: Sequence[MatchedPair], counted: Sequence[int]) -> dict[int, list[int]]:
    """Indices of the pairs with most matches for each photograph among the ``counted`` ones, at most `PARTNERS` of them."""
    of: dict[int, list[int]] = {}
    for index in sorted(counted, key=lambda index: (-len(pairs[index]), index)):
        for photo in (pairs[index].first, pairs[index].second):
            if len(of.setdefault(photo, [])) < PARTNERS:
                of[photo].append(index)
    return of


def _ends(pair: MatchedPair) -> tuple[int, int]:
    return pair.first, pair.second


def _agreement(indices: Sequence[int], shares: dict[int, float], pairs: Sequence[MatchedPair]) -> float:
    """Share of a photograph's matches with its partners that the poses explain."""
    return float(np.average([shares[index] for index in indices], weights=[len(pairs[index]) for index in indices]))


def _row(pair: MatchedPair, share: float, photos: Sequence[Prepared]) -> dict[str, Any]:
    return {"photos": [photos[pair.first].source, photos[pair.second].source], "matches": len(pair), "explained": share}


def _sentence(found: dict[str, Any], suspicious: bool) -> str:
    pairs = f"{found['contradicting']} of the {found['pairs']} best matched pairs of photographs contradict the poses"
    if not suspicious:
        return pairs
    example = f" (such as {' and '.join(found['worst'][0]['photos'])})" if found["worst"] else ""
    doubt = f"{len(found['doubtful'])} of {found['asked']} photographs do not agree with their neighbours"
    return (
        f"{'; '.join([pairs + example, doubt, *found['implausible']])}. Parts that look alike may have been taken for one, or "
        "the focal length be wrong: look at top-view.png. More photographs between those that disagree help most."
    )


def explained_share(first: Any, second: Any, pair: MatchedPair) -> float:
    """Share of a pair's matches that two posed ``pycolmap.Image`` explain.

    A match is explained if it lies within `NEAR` pixels (Sampson's distance, pixels of the first photograph) of the epipolar
    lines, and its rays do not meet behind the cameras by more than as many pixels. Lenses are taken into account.
    """
    relative = second.cam_from_world() * first.cam_from_world().inverse()
    matrix = np.asarray(relative.matrix())
    planes = [_plane(image, points) for image, points in zip((first, second), pair.points, strict=True)]
    distance = sampson(matrix[:, :3], matrix[:, 3], planes[0], planes[1])
    angle = parallax(matrix[:, :3], matrix[:, 3], planes[0], planes[1])
    focal = first.camera.mean_focal_length()
    return float(np.mean((distance * focal < NEAR) & (angle * focal > -NEAR)))


def parallax(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, 3], first: Float[np.ndarray, "m 2"], second: np.ndarray
) -> Float[np.ndarray, " m"]:
    """Angle in radians at which the rays of matches meet in front of both cameras; negative where they part.

    Arguments as of `sampson`. It is the difference of the rays' angles with the baseline, zero without one.
    """
    length = float(np.linalg.norm(translation))
    if length == 0:
        return np.zeros(len(first))
    rays = [np.column_stack([plane, np.ones(len(plane))]) for plane in (first, second)]
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in (rays[0] @ rotation.T, rays[1])]
    angles = [np.arccos((ray @ (-translation / length)).clip(-1, 1)) for ray in rays]
    return angles[1] - angles[0]


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
