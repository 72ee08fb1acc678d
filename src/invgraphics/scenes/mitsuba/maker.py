"""`make`: rendered ground truth of a scene, from the cache or by a rendering process."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

from invgraphics.core.believable import check_camera
from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.memory import check_fits
from invgraphics.scenes.mitsuba import cache, llvm
from invgraphics.scenes.mitsuba.forecast import RenderingForecast
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.larger import averaged
from invgraphics.scenes.mitsuba.rig import SPLITS, cameras, make_rig
from invgraphics.scenes.mitsuba.spec import Counts, SceneSpec, description_path, read
from invgraphics.scenes.process import Progress, run_worker

FILM_BYTES = 44
"""Of a pixel while its view is rendered: colour, alpha, depth and normal, and their filter weights."""
PICTURE_BYTES = 20
"""Of a pixel of a view that is loaded: colour and alpha of 8 bits, depth and normal of 32."""


def make(
    name: str | SceneSpec,
    *,
    size: tuple[int, int] | None = None,
    train: int | None = None,
    test: int | None = None,
    spp: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Render a scene's ground truth, or take it from the cache, at this size or averaged from a larger one.

    What takes time is announced on the terminal before it begins.

    Args:
        name: of a built-in scene, the path of one's own ``scene.toml``, or a description (see `SceneSpec.with_instances`).
        size: width and height in pixels. For this and what follows, ``None`` means what the scene's description says.
        train: number of training views.
        test: number of test views.
        spp: samples per pixel of the training views; the other splits' keep their proportion to it. Averages then serve only
            if they have exactly these; without it, more samples than the description says are as good.
        seed: of the camera positions and of the renderer's noise.
        out: folder to put a copy into; ``None`` leaves the scene in the cache only.
        progress: called with (views done, views in all, what is being done).

    Returns:
        The folder of the scene, see `invgraphics.scenes.truth`.

    Raises:
        InputError: unknown scene, impossible option, unwritable folder, or the renderer failed.
    """
    job = planned(name, size, (train, test), spp, seed)
    folder = cache.root() / job.folder_name
    if cache.read_truth(folder) is None and (smaller := averaged(job, exact=spp is not None)) is not None:
        job, folder = smaller, cache.root() / smaller.folder_name
    report = progress or (lambda done, total, what: None)
    if cache.read_truth(folder) is None:
        with cache.locked(folder, waiting=lambda: report(0, job.total, "waiting for another process that renders it")) as lock:
            if cache.read_truth(folder) is None:  # that process may have made it meanwhile
                _make(job, folder, report, lock)
    return folder if out is None else cache.copy(folder, Path(out))


def cached_with_more_tests(
    scene: str, size: tuple[int, int] | None, views: tuple[int | None, int | None], spp: int | None, seed: int
) -> Path | None:
    """Folder in the cache that has all of the scene's test views, where fewer are asked for: those are its first.

    Cameras and noise of a view do not depend on how many follow, so its pictures are those that `make` would render.

    Returns:
        ``None`` where no fewer are asked for, these are there themselves, or nothing that would do is in the cache.
    """
    job = planned(scene, size, views, spp, seed)
    own = job.spec.views.test
    if job.spec.instances is not None or job.views.test >= own or cache.read_truth(cache.root() / job.folder_name) is not None:
        return None
    folder = cache.root() / replace(job, views=replace(job.views, test=own)).folder_name
    return folder if cache.read_truth(folder) is not None else None


def planned(
    scene: str | SceneSpec, size: tuple[int, int] | None, views: tuple[int | None, int | None], spp: int | None, seed: int
) -> Job:
    """Check a request for a rendering before anything is done; arguments and errors as `make`."""
    spec = scene if isinstance(scene, SceneSpec) else read(description_path(scene))
    limits = (
        ("The size", size and min(size), 8),
        ("The number of training views", views[0], 1),
        ("The number of test views", views[1], 1),
        ("The number of samples per pixel", spp, 1),
        ("The seed", seed, 0),
    )
    for what, value, least in limits:
        if value is not None and value < least:
            raise InputError(f"{what} cannot be {value}.", f"Expected: at least {least}.")
    train, test = (
        default if given is None else given for given, default in zip(views, (spec.views.train, spec.views.test), strict=True)
    )
    samples = spec.samples if spp is None else spec.samples.scaled(spp)
    job = Job(spec, size or spec.size, Counts(train, spec.views.val, test), samples, seed, llvm.status().variant)
    (width, height), remedy = job.size, "Choose a lower --size, or fewer views."
    needed = width * height * (FILM_BYTES + job.total * PICTURE_BYTES)
    check_fits(needed, f"The scene '{spec.name}' with {job.total:,} views of {width:,}x{height:,} pixels", remedy)
    rig = make_rig(spec.rig)
    for split in SPLITS:
        for index, camera in enumerate(cameras(rig, split, getattr(job.views, split), job.size, seed)):
            check_camera(camera, f"the {split} view {index} of '{spec.name}'")
    return job


def _make(job: Job, folder: Path, progress: Progress, lock: int) -> None:
    """Render to a temporary folder, renamed when it is complete."""
    partial = folder.with_name(f"{folder.name}.partial")
    request = partial / cache.REQUEST
    try:
        shutil.rmtree(folder, ignore_errors=True)  # a broken one, see `cache.read_truth`
        partial.mkdir(exist_ok=True)
        _remove_unfinished(partial)
        write_text(request, json.dumps(job.table()))
        _run(job, partial, progress, lock)
        request.unlink()
        partial.replace(folder)
    except OSError as error:
        raise cache.unwritable(partial, error) from error


def _remove_unfinished(partial: Path) -> None:
    """Remove files that a killed process was writing: ``truth.json`` would list its own among the scene's.

    Not left out where ``truth.json`` is written: that module's source is part of the keys of all renderings.
    """
    for path in partial.rglob("*.tmp"):
        path.unlink()


def _run(job: Job, partial: Path, progress: Progress, lock: int) -> None:
    width, height = job.size
    if job.spec.instances is not None:
        module = "instances"
        of_what = f"{job.total:,} views of {job.spec.instances.total} instances"
        _notify(f"{job.spec.name} at {width}x{height}: {of_what}; cached afterwards.")
    elif job.source is None:
        module, progress = "render", RenderingForecast(job, partial, progress, _notify)
    else:
        module = "average"
        larger = "x".join(map(str, job.source.size))
        _notify(f"{job.spec.name} at {width}x{height}: {job.total} views averaged from those at {larger} in the cache.")
    run_worker(
        f"invgraphics.scenes.mitsuba.{module}",
        partial,
        progress,
        subject=f"The scene '{job.spec.name}' could not be rendered",
        remedy="If memory ran out, make it smaller (--size, --spp).",
        environment=llvm.status().environment(),
        lock=lock,
    )


def _notify(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)
