"""From matches to poses and points with pycolmap, by one strategy."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.files import copy_file
from invgraphics.scenes.photos.job import DATABASE, PhotoJob
from invgraphics.scenes.photos.pairs import VerifiedMatches
from invgraphics.scenes.photos.prepare import PHOTOS, Prepared
from invgraphics.scenes.photos.sfm import Verification, match, reset_cameras
from invgraphics.scenes.photos.strategies import Strategy
from invgraphics.scenes.process import Progress

MODELS, COPY = "models", "copy.db"
"""Folder of what COLMAP writes on the way; and the data base of a strategy that changes more than cameras."""

_SMALLEST_MODEL = 3


@dataclass(frozen=True)
class Matched:
    """Features and verified matches that every strategy starts from.

    Attributes:
        job: settings of the import.
        photos: the working copies.
        evidence: verified pairs.
        work: folder of the data base; its features and matches stay as they are.
    """

    job: PhotoJob
    photos: Sequence[Prepared]
    evidence: VerifiedMatches
    work: Path


def reconstruct(strategy: Strategy, matched: Matched, progress: Progress) -> list[Any]:
    """Estimate poses and points: separate pieces where the photographs do not hang together, the largest first.

    Args:
        strategy: how.
        matched: features and matches.
        progress: called with (done, in all, what is being done).

    Returns:
        ``pycolmap.Reconstruction`` objects.
    """
    from invgraphics.scenes.colmap_library import pycolmap

    count, seed = len(matched.photos), matched.job.seed
    output = matched.work / MODELS
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    path = _database(strategy, matched, progress)
    pycolmap.set_random_seed(seed)
    what = f"placing photographs: {strategy.name}"
    progress(0, count, what)
    placed = iter(range(1, count + 1))
    place = _global if strategy.mapper == "global" else _incremental
    models = place(strategy, seed, path, output, lambda: progress(next(placed, count), count, what))
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _database(strategy: Strategy, matched: Matched, progress: Progress) -> Path:
    """The data base that the strategy needs."""
    from invgraphics.scenes.colmap_library import pycolmap

    path = matched.work / DATABASE
    reset_cameras(matched.photos, path, strategy.lens)
    if not (strategy.calibrated or strategy.guided):
        return path
    copy = matched.work / COPY
    for left in (COPY, f"{COPY}-wal", f"{COPY}-shm"):  # a killed process's log, which SQLite would replay into the new copy
        (matched.work / left).unlink(missing_ok=True)
    copy_file(path, copy)
    if strategy.guided:
        with pycolmap.Database.open(copy) as database:
            database.clear_matches()
            database.clear_two_view_geometries()
        pairs = [(pair.first, pair.second) for pair in matched.evidence.pairs]
        match(pairs, matched.photos, copy, progress, Verification(matched.job.seed, guided=True))
    if strategy.calibrated:
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed = matched.job.seed
        pycolmap.calibrate_view_graph(copy, options)
    return copy


def _global(strategy: Strategy, seed: int, path: Path, output: Path, count: Callable[[], None]) -> dict[int, Any]:
    from invgraphics.scenes.colmap_library import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    # One thread, because more would add up rounding errors in another order from run to run.
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = seed
    return pycolmap.global_mapping(path, output.parent / PHOTOS, output, options)


def _incremental(strategy: Strategy, seed: int, path: Path, output: Path, count: Callable[[], None]) -> dict[int, Any]:
    from invgraphics.scenes.colmap_library import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # see `_global`
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = _SMALLEST_MODEL
    options.mapper.init_min_tri_angle = strategy.initial_angle
    return pycolmap.incremental_mapping(
        path, output.parent / PHOTOS, output, options, initial_image_pair_callback=count, next_image_callback=count
    )
