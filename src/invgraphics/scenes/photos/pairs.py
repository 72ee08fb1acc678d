"""Geometrically verified matches between pairs of photographs, read from COLMAP's database as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.photos.prepare import Prepared


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Verified matches between two photographs.

    Attributes:
        first: index of one photograph.
        second: index of the other.
        points: image positions of the matches in both, pixels.
    """

    first: int
    second: int
    points: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]

    def __len__(self) -> int:
        return len(self.points[0])

    @property
    def motion(self) -> float:
        """Median displacement of the matches, pixels."""
        return float(np.median(np.linalg.norm(self.points[0] - self.points[1], axis=1)))


@dataclass(frozen=True, eq=False)
class VerifiedMatches:
    """Features and verified matches of a set of photographs.

    Attributes:
        features: number in each photograph.
        pairs: those that COLMAP's two-view verification accepts.
    """

    features: tuple[int, ...]
    pairs: tuple[MatchedPair, ...]

    def partners(self, index: int) -> int:
        """Number of photographs that one photograph has verified matches with."""
        return sum(index in (pair.first, pair.second) for pair in self.pairs)


def read_verified_matches(path: Path, photos: Sequence[Prepared]) -> VerifiedMatches:
    """Read features and verified matches from a COLMAP database."""
    from invgraphics.scenes.colmap_library import pycolmap

    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        numbers = [ids[photo.name] for photo in photos]
        places = [np.asarray(database.read_keypoints(image))[:, :2] for image in numbers]
        index = {image: position for position, image in enumerate(numbers)}
        pairs = []
        for first, second, geometry in _verified(database):
            i, j = index[first], index[second]
            matches = np.asarray(geometry.inlier_matches)
            pairs.append(MatchedPair(i, j, (places[i][matches[:, 0]], places[j][matches[:, 1]])))
    return VerifiedMatches(
        tuple(len(place) for place in places), tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second)))
    )


def _verified(database: Any) -> list[tuple[int, int, Any]]:
    from invgraphics.scenes.colmap_library import pycolmap

    found = []
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        if len(geometry.inlier_matches):
            found.append((*pycolmap.pair_id_to_image_pair(pair_id), geometry))
    return found
