"""Features, matches and poses with pycolmap; a stage that was interrupted goes on where it stopped."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from invgraphics.scenes.photos.job import EXHAUSTIVE, MODELS, PhotoJob
from invgraphics.scenes.photos.prepare import MASKS, PHOTOS, Prepared
from invgraphics.scenes.process import Progress

DATABASE, MODEL = "database.db", "model"

NEIGHBOURS = 10
"""Sequential matching pairs a photograph with as many after it, and with those 16, 32, 64 … places on, as COLMAP does."""

_CHUNK = 8  # photographs whose features are extracted between two lines of progress
_PAIRS = 100  # pairs matched between two lines of progress
_SMALLEST_MODEL = 3


def enter(job: PhotoJob, photos: Sequence[Prepared], work: Path) -> None:
    """Write cameras and photographs into a data base, in order: threads that extract features would number them by chance."""
    from invgraphics.scenes.colmap_library import pycolmap

    path = work / DATABASE
    with pycolmap.Database.open(path) as database:
        if database.num_images() == len(photos):
            return
        database.clear_all_tables()  # what an interrupted call has begun
    groups: dict[str, list[Prepared]] = {}
    for photo in photos:
        groups.setdefault(photo.group, []).append(photo)
    for members in groups.values():
        names = [photo.name for photo in members]
        pycolmap.import_images(path, work / PHOTOS, pycolmap.CameraMode.SINGLE, names, _reader(job, members))


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

    data_set = members[0].centre is not None
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE" if data_set else MODELS[job.lens]
    focals = [photo.focal for photo in members if photo.focal is not None]
    if focals:
        width, height = members[0].width, members[0].height
        camera = pycolmap.Camera.create_from_model_name(0, reader.camera_model, float(np.median(focals)), width, height)
        if members[0].centre is not None:
            camera.principal_point_x, camera.principal_point_y = members[0].centre
        reader.camera_params = ", ".join(repr(float(value)) for value in camera.params)
    return reader


def pairs(count: int, matching: str) -> list[tuple[int, int]]:
    """Which photographs, counted in natural name order, are compared."""
    exhaustive = matching == "exhaustive" or (matching == "auto" and count <= EXHAUSTIVE)
    if exhaustive:
        return list(combinations(range(count), 2))
    steps = sorted({*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, NEIGHBOURS))})
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]


def match(job: PhotoJob, photos: Sequence[Prepared], work: Path, progress: Progress) -> None:
    """Compare and verify all pairs that are asked for; those in the data base already are left alone."""
    from invgraphics.scenes.colmap_library import pycolmap

    wanted = pairs(len(photos), job.matching)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = work / "pairs.txt"
    for start in range(0, len(wanted), _PAIRS):
        progress(start, len(wanted), f"matching {len(wanted)} pairs")
        lines = [f"{photos[i].name} {photos[j].name}" for i, j in wanted[start : start + _PAIRS]]
        pairing.match_list_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        pycolmap.match_image_pairs(work / DATABASE, pairing_options=pairing, verification_options=verification)


def reconstruct(job: PhotoJob, photos: Sequence[Prepared], work: Path, progress: Progress) -> list[Any]:
    """Poses and points: separate pieces where the photographs do not hang together, the largest first."""
    from invgraphics.scenes.colmap_library import pycolmap

    output = work / MODEL
    output.mkdir(exist_ok=True)
    pycolmap.set_random_seed(job.seed)
    registered = 0

    def count() -> None:
        nonlocal registered
        registered += 1
        progress(min(registered, len(photos)), len(photos), "placing photographs")

    progress(0, len(photos), "placing photographs")
    if job.mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        # One thread, because more would add up rounding errors in another order from run to run.
        options.num_threads = options.mapper.num_threads = 1
        options.random_seed = options.mapper.random_seed = job.seed
        models = pycolmap.global_mapping(work / DATABASE, work / PHOTOS, output, options)
    else:
        steps = pycolmap.IncrementalPipelineOptions()
        steps.num_threads = steps.mapper.num_threads = 1
        steps.random_seed = steps.mapper.random_seed = steps.triangulation.random_seed = job.seed
        steps.min_model_size = _SMALLEST_MODEL
        models = pycolmap.incremental_mapping(
            work / DATABASE, work / PHOTOS, output, steps, initial_image_pair_callback=count, next_image_callback=count
        )
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
