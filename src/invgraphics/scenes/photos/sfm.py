"""Feature extraction and matching with pycolmap; interrupted stages resume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from invgraphics.files import write_text
from invgraphics.scenes.photos.job import DATABASE, EXHAUSTIVE, MODELS, SECOND_TRY, PhotoJob
from invgraphics.scenes.photos.prepare import MASKS, PHOTOS, Prepared
from invgraphics.scenes.process import Progress

NEIGHBOURS = 10
"""Sequential matching pairs a photograph with as many after it, and with those 16, 32, 64 … places on, as COLMAP does."""

_CHUNK = 8  # photographs whose features are extracted between two lines of progress
_PAIRS = 100  # pairs matched between two lines of progress
_GUESS = 1.2  # focal length over the longest side where no metadata gives it, as in COLMAP


@dataclass(frozen=True)
class Verification:
    """How pairs are matched: the seed of RANSAC, and whether matches are looked for again along the epipolar lines found."""

    seed: int = 0
    guided: bool = False


def write_database(job: PhotoJob, photos: Sequence[Prepared], work: Path) -> None:
    """Write cameras and photographs into a data base, in order: threads that extract features would number them by chance."""
    from invgraphics.scenes.colmap_library import pycolmap

    path = work / DATABASE
    with pycolmap.Database.open(path) as database:
        if database.num_images() == len(photos):
            return
        database.clear_all_tables()  # what an interrupted call has begun
    for members in _groups(photos).values():
        names = [photo.name for photo in members]
        pycolmap.import_images(path, work / PHOTOS, pycolmap.CameraMode.SINGLE, names, _reader(job, members))


def reset_cameras(photos: Sequence[Prepared], path: Path, lens: str) -> None:
    """Give each group's camera in the data base a lens model, with what is known of it before any reconstruction."""
    from invgraphics.scenes.colmap_library import pycolmap

    with pycolmap.Database.open(path) as database:
        cameras = {image.name: image.camera_id for image in database.read_all_images()}
        for members in _groups(photos).values():
            camera = _camera(members, _model(members[0], lens))
            camera.camera_id = cameras[members[0].name]
            database.update_camera(camera)


def _groups(photos: Sequence[Prepared]) -> dict[str, list[Prepared]]:
    """Photographs that share a camera."""
    groups: dict[str, list[Prepared]] = {}
    for photo in photos:
        groups.setdefault(photo.group, []).append(photo)
    return groups


def extract(photos: Sequence[Prepared], work: Path, progress: Progress) -> None:
    """Add the SIFT features of photographs that have none yet to the data base."""
    from invgraphics.scenes.colmap_library import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if any(photo.masked for photo in photos):  # there is a mask for each, but reading them takes time
        reader.mask_path = str(work / MASKS)
    for start in range(0, len(photos), _CHUNK):
        names = [photo.name for photo in photos[start : start + _CHUNK]]
        progress(start, len(photos), f"features of {names[0]}")
        pycolmap.extract_features(work / DATABASE, work / PHOTOS, names, pycolmap.CameraMode.AUTO, reader)


def _reader(job: PhotoJob, members: Sequence[Prepared]) -> Any:
    """How COLMAP makes a group's camera: with the known focal length, or with a guess, which does not count as known."""
    from invgraphics.scenes.colmap_library import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = _model(members[0], "radial" if job.lens == "auto" else job.lens)
    if any(photo.focal is not None for photo in members):
        camera = _camera(members, reader.camera_model)
        reader.camera_params = ", ".join(repr(float(value)) for value in camera.params)
    return reader


def _model(photo: Prepared, lens: str) -> str:
    return "PINHOLE" if photo.centre is not None else MODELS[lens]


def _camera(members: Sequence[Prepared], model: str) -> Any:
    """A group's camera before any reconstruction."""
    from invgraphics.scenes.colmap_library import pycolmap

    width, height = members[0].width, members[0].height
    focals = [photo.focal for photo in members if photo.focal is not None]
    focal = float(np.median(focals)) if focals else _GUESS * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    camera.has_prior_focal_length = bool(focals)
    if members[0].centre is not None:
        camera.principal_point_x, camera.principal_point_y = members[0].centre
    return camera


def pairs(count: int, matching: str) -> list[tuple[int, int]]:
    """Which photographs, counted in natural name order, are compared."""
    exhaustive = matching == "exhaustive" or (matching == "auto" and count <= EXHAUSTIVE)
    if exhaustive:
        return list(combinations(range(count), 2))
    steps = sorted({*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, NEIGHBOURS))})
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]


def may_match_all(matching: str, count: int) -> bool:
    """Whether all pairs may be compared in a second try: `pairs` chose the neighbours by itself, and it takes no days."""
    return matching == "auto" and EXHAUSTIVE < count <= SECOND_TRY


def match(
    wanted: Sequence[tuple[int, int]], photos: Sequence[Prepared], path: Path, progress: Progress, verification: Verification
) -> None:
    """Match pairs of photographs and verify their two-view geometry; those in the data base already are left alone.

    Args:
        wanted: pairs of indices into ``photos``.
        photos: as the data base was filled with.
        path: the data base.
        progress: called with (done, in all, what is being done).
        verification: how.
    """
    from invgraphics.scenes.colmap_library import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.guided_matching = verification.guided
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = verification.seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = path.parent / "pairs.txt"
    for start in range(0, len(wanted), _PAIRS):
        progress(start, len(wanted), f"matching {len(wanted)} pairs")
        lines = [f"{photos[i].name} {photos[j].name}" for i, j in wanted[start : start + _PAIRS]]
        write_text(Path(pairing.match_list_path), "\n".join(lines) + "\n")
        pycolmap.match_image_pairs(path, matching, pairing, geometry)
