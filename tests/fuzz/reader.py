"""A process that reads inputs, one line of JSON each way, so that the fuzzer can watch and end it.

What is accepted is checked here by numpy alone: rays of every camera, pixels, points and Gaussians are finite and sensible.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from invgraphics.errors import InputError

MEMORY = 1 << 30
"""Bytes that reading one input may take at its peak, beyond what the process holds when it is ready."""
ENOUGH = 2 * MEMORY
"""Bytes beyond which the process gets no more: it fails there, so that the machine does not."""


def read_scene(path: Path) -> str:
    """Open a scene; returns a digest of what was read."""
    from invgraphics.scenes.open import open_scene

    scene = open_scene(str(path))
    views = [*scene.train, *scene.val, *scene.test]
    sha = hashlib.sha256()
    for view in views:
        rays = view.camera.rays()
        directions, origins = rays.directions.double().numpy(), rays.origins.double().numpy()
        assert np.isfinite(directions).all() and np.isfinite(origins).all(), "rays are not finite"
        assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-3, "directions are no unit vectors"
        assert np.abs(origins).max() < 1e6, "a camera is out of this world"
        assert len(np.unique(directions, axis=0)) == len(directions), "pixels share a ray"
        image = view.image.numpy()
        assert image.shape == (view.camera.height, view.camera.width, 3) and image.dtype == np.uint8, "no picture"
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 3, "a picture is smeared"
        for values in (directions.astype(np.float32), origins.astype(np.float32), image):
            sha.update(values.tobytes())
        for geometry in (view.depth, view.normal):
            sha.update(b"" if geometry is None else geometry.float().numpy().tobytes())
    assert np.isfinite(scene.extent) and np.isfinite(scene.scale), "the extent is not finite"
    for values in (scene.bounds.lo, scene.bounds.hi, scene.world_from_local):
        assert bool(values.isfinite().all()), "bounds or frame are not finite"
        sha.update(values.numpy().tobytes())
    assert np.isfinite(scene.bounds.near), "no near plane"
    if scene.mesh is not None:
        vertices, faces = scene.mesh.vertices, scene.mesh.faces
        assert bool((vertices**2).isfinite().all()) and bool(((faces >= 0) & (faces < len(vertices))).all()), "no mesh"
        sha.update(vertices.numpy().tobytes() + faces.numpy().tobytes())
    assert scene.noise_ceiling is None or np.isfinite(scene.noise_ceiling), "no noise ceiling"
    if scene.points is not None:
        squared = (scene.points.position**2).sum(dim=1)
        assert bool(squared.isfinite().all()) and bool(scene.points.rgb.isfinite().all()), "points are not finite"
        sha.update(scene.points.position.numpy().tobytes())
    return sha.hexdigest()


def read_description(path: Path) -> str:
    """Read a description of a scene and place its cameras; returns a digest of it."""
    from invgraphics.scenes.mitsuba import maker
    from invgraphics.scenes.mitsuba.rig import cameras, make_rig

    job = maker.planned(str(path), None, (None, None), None, 0)
    rig = make_rig(job.spec.rig)
    for camera in cameras(rig, "train", job.views.train, job.size, job.seed):
        assert bool(camera.rays().directions.isfinite().all()) and bool(camera.position.isfinite().all()), "no rays"
    assert np.isfinite([*job.spec.lo, *job.spec.hi, *(job.spec.background or ())]).all(), "not finite"
    return hashlib.sha256(json.dumps(job.table()).encode()).hexdigest()


def read_camera_path(path: Path) -> str:
    """Read a camera path and its cameras; returns a digest of them."""
    from invgraphics.tools.camera_path import read_camera_path as read

    way, sha = read(path), hashlib.sha256()
    for keyframe in (*way.keyframes, *way.at(way.frame_times(5))):
        pose = keyframe.pose.float()
        assert bool((pose**2).isfinite().all()) and 0 < keyframe.fov < np.pi, "no camera"
        sha.update(pose.numpy().tobytes() + np.float32(keyframe.fov).tobytes())
    return sha.hexdigest()


def read_gaussians(path: Path) -> str:
    """Read a file of Gaussians; returns a digest of them."""
    from invgraphics.formats.base import read_gaussians as read

    _, splats = read(path)
    gaussians, sha = splats.gaussians, hashlib.sha256()
    norm = np.linalg.norm(gaussians.quaternions.numpy(), axis=1)  # in float32, as kernels do it
    assert np.isfinite(norm).all() and norm.min() > 0, "a rotation cannot be normalised"
    assert bool(((gaussians.scales**2).isfinite() & (gaussians.scales >= 0)).all()), "scales have no squares"
    assert 0 <= float(gaussians.opacities.min()) <= float(gaussians.opacities.max()) <= 1, "opacities beyond [0, 1]"
    for values in (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh):
        assert bool(values.isfinite().all()) and float(values.abs().max()) < 1e12, "not finite"
        sha.update(values.numpy().tobytes())
    return sha.hexdigest()


def read_recipe(path: Path) -> str:
    """Read a recipe; returns its digest."""
    from invgraphics.recipes.recipe import load_method

    method = load_method(str(path))
    json.dumps(method.table, allow_nan=False)
    return method.digest


def read_study(path: Path) -> str:
    """Read a study and expand it; returns a digest."""
    from invgraphics.studies.reading import read_study as read

    cells = read(path).expand()
    assert 0 < len(cells) <= 100_000, "no study has as many cells"
    return hashlib.sha256(repr(cells).encode()).hexdigest()


def _digest(*records: Any) -> str:
    from invgraphics.runs.schema import plain

    return hashlib.sha256(json.dumps(plain(records), sort_keys=True).encode()).hexdigest()


def read_run(path: Path) -> str:
    """Read a run's records; returns a digest of them."""
    from invgraphics.runs.run import read_run as read

    run = read(path)
    assert all(isinstance(moment.step, int) and np.isfinite(moment.seconds) for moment in run.history), "no history"
    return _digest(run.scores, run.provenance, run.environment, run.history, run.seed)


def read_comparison(path: Path) -> str:
    """Read a comparison and its runs; returns a digest."""
    from invgraphics.report.data.comparison import read_comparison as read

    comparison = read(path)
    assert all(run.folder.resolve().is_relative_to(path.resolve()) for run in comparison.runs), "a run elsewhere"
    runs = [(run.scores, run.provenance, run.environment, run.history) for run in comparison.runs]
    return _digest(runs, comparison.methods, comparison.question, comparison.protocol, comparison.environment)


def read_study_cells(path: Path) -> str:
    """Read a study's folder, as its report does; returns a digest."""
    from invgraphics.report.data.studies import read_study as read
    from invgraphics.report.data.studies import scene_comparisons

    study = read(path)
    return _digest(study.question, [cell.label for cell in study.cells], len(scene_comparisons(study)), study.methods)


def read_pictures(path: Path) -> str:
    """Read all saved predictions and their truth; returns a digest."""
    from invgraphics.tools.predictions import open_pictures

    pictures, sha = open_pictures(path), hashlib.sha256()
    for index in range(len(pictures.names)):
        predicted, truth = pictures.prediction(index, True), pictures.truth(index)
        height, width = predicted.alpha.shape
        assert predicted.rgb.shape == (height, width, 3) and truth.image.shape[2] == 3, "no picture"
        sha.update(predicted.rgb.numpy().tobytes() + truth.image.numpy().tobytes())
    return sha.hexdigest()


def read_checkpoint(path: Path) -> str:
    """Read a checkpoint; returns a digest of its tensors."""
    from invgraphics.runs.checkpoint import load

    sha = hashlib.sha256()
    for section, part in sorted(load(path).items()):
        for name, value in sorted(part.items()):
            numbers = value.float().numpy()
            assert bool(value.isfinite().all()), f"{section}.{name} is not finite"
            sha.update(f"{section}|{name}{tuple(value.shape)}".encode() + numbers.tobytes())
    return sha.hexdigest()


def make_page(kind: str, path: Path) -> str:
    """Write a report into a folder of its own; returns nothing of it, whose order follows the records."""
    from invgraphics.report.build import build_from_runs, build_report
    from invgraphics.report.study import build_study_report

    with tempfile.TemporaryDirectory() as out:
        if kind == "study_page":
            page = build_study_report(path, Path(out))
        else:
            page = build_report(path, Path(out)) if kind == "page" else build_from_runs([path], Path(out))
        assert "</html>" in page.read_text(encoding="utf-8"), "no page"
    return kind


READERS: dict[str, Callable[[Path], str]] = {
    "scene": read_scene,
    "gaussians": read_gaussians,
    "recipe": read_recipe,
    "study": read_study,
    "run": read_run,
    "comparison": read_comparison,
    "study_cells": read_study_cells,
    "pictures": read_pictures,
    "checkpoint": read_checkpoint,
    "description": read_description,
    "camera_path": read_camera_path,
} | {kind: partial(make_page, kind) for kind in ("page", "run_page", "study_page")}


def main() -> None:
    """Answer requests ``[kind, path, whether it is good]`` with ``[outcome, what]`` until there are none.

    After a good input, all libraries for its like are loaded, and the bounds of memory start from what the process holds then.
    """
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if "INVGRAPHICS_FUZZ" not in os.environ:
        _leave_plots_unpainted()
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        kind, path, good = json.loads(line)
        if good:
            resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY,) * 2)
        before = status_bytes("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # the peak of resident memory starts anew (Linux's proc(5))
        try:
            answer: Any = ["accepted", READERS[kind](Path(path))]
        except InputError as error:
            answer = ["refused", str(error)] if not lacked_memory(error) else ["raised", traceback.format_exc()]
        except BaseException:
            answer = ["raised", traceback.format_exc()]
        if good:
            resource.setrlimit(resource.RLIMIT_DATA, (status_bytes("VmData") + ENOUGH, resource.RLIM_INFINITY))
        elif (taken := status_bytes("VmHWM") - before) > MEMORY:
            answer = ["greedy", f"{taken >> 20} MiB; {answer}"]
        print(json.dumps(answer), file=answers, flush=True)


def _leave_plots_unpainted() -> None:
    """Lay plots out only: painting takes two thirds of a page's time, and depends on no input that layout does not see."""
    from matplotlib.figure import Figure

    Figure.draw_without_rendering = lambda figure: None
    Figure.savefig = lambda figure, file, **settings: file.write("<svg/>")


def lacked_memory(error: BaseException | None) -> bool:
    """Whether an exception goes back to an allocation beyond `ENOUGH`; Python's parser says so of nesting as well."""
    while error is not None:
        if "can't allocate memory" in str(error) or (isinstance(error, MemoryError) and "arser" not in str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def status_bytes(entry: str) -> int:
    """Bytes of an entry of ``/proc/self/status``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(f"{entry}:"))


if __name__ == "__main__":
    main()
