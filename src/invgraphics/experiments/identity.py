"""Identity of runs: SHA-256 of everything that determines a result."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from invgraphics import kernels, plugins
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.environment import code_version, deciding_packages
from invgraphics.experiments.job import Job
from invgraphics.runs.environment import Environment
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import SCENE_COPY, SHARED_ABOVE, RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.degrade import TrainingData
from invgraphics.scenes.open import is_rendered
from invgraphics.text import sha256_of
from invgraphics.training.budget import Budget


def truth_digest(scene: Scene) -> str:
    """Hash all of a scene as loaded that fits and scores may read, without keeping its pixels in memory.

    Names, notes and the noise level of a rendered truth are no part of it.
    """
    sha = hashlib.sha256()
    _update(sha, replace(scene, notes={}, noise_ceiling=None))
    return sha.hexdigest()


def _update(sha: hashlib._Hash, value: object) -> None:
    """Feed a value to a hash: dataclasses, tuples and tensors by what they hold, all else by its representation."""
    if isinstance(value, Tensor):
        sha.update(repr((tuple(value.shape), str(value.dtype))).encode())
        sha.update(np.ascontiguousarray(value.detach().cpu().numpy()).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        for part in (part for part in fields(value) if part.name != "name"):
            sha.update(f"{part.name}:".encode())
            _update(sha, getattr(value, part.name))
    elif isinstance(value, tuple):
        sha.update(f"{len(value)}:".encode())
        for part in value:
            _update(sha, part)
    else:
        sha.update(f"{value!r};".encode())


def run_digest(job: Job, truth: str, threads: int) -> str:
    """Hash everything that determines a run's fit; equal identities mean equal bits on one machine.

    The protocol is no part of it: a finished fit is scored by another one from its checkpoint.

    Args:
        job: of the run; its degradations of training data follow from the truth as loaded, the settings and the seed, so that
            nothing needs to be disturbed to know them.
        truth: `truth_digest` of the scene as loaded.
        threads: of the process that fits, which decide the order of sums.
    """
    method = job.method
    source = getattr(method.recipe.field, "source", "")
    more: dict[str, Any] = {"source": _source_digest(Path(source))} if source else {}
    if foreign := plugins.plugin_sources(method.table, method.name):
        more["plugins"] = foreign
    return sha256_of(
        more
        | {
            "method": method.name,
            "recipe": method.digest,
            "truth": truth,
            "data": job.data.changes(),
            "request": _fit_settings(job) | {"kernels": job.request.kernels or kernels.in_use(job.device)},
            "code": code_version(),
            "packages": deciding_packages(job.device),
            "threads": threads,
        }
    )


def _source_digest(source: Path) -> str:
    """Hash what a field starts from: a run's identity with the steps it has had, or a file's bytes; empty where nothing is."""
    if source.is_file():
        with source.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    run = RunFolder(source)
    return f"{run.identity}@{run.read(FitRecord).steps}" if run.has(FitRecord) else run.identity


def check_replaceable(job: Job, threads: int | None = None) -> None:
    """Check that a job's folder holds no run on another request; only what other code or other pixels made is replaced.

    Args:
        job: of the run.
        threads: that its fit would have; ``None`` for any. A finished fit with others is not replaced unasked.

    Raises:
        InputError: it does; the sentence names the first setting that differs.
    """
    folder = job.folder
    if not folder.has(Provenance):
        return
    found, request = folder.read(Provenance), job.request
    settings = {
        "scene": (found.scene, found.scene if _same_scene(folder, found.scene, request.scene) else request.scene),
        "seed": (found.seed, request.seed),
        "budget": (_normalised(found.budget), str(job.budget)),
        "size": (found.options.size, request.size),
        "number of test views": (found.options.test_views, request.test_views),
        "samples per pixel": (found.options.spp, request.spp),
        "training data": (found.data, job.data.changes()),
        "device": (found.device, str(job.device)),
    }
    if request.kernels is not None and folder.has(Environment):
        settings["kernels"] = (folder.read(Environment).kernels, request.kernels)
    if threads is not None and found.threads is not None:
        settings["number of threads"] = (found.threads, threads)
    if found.recipe_sha256 not in job.recipe_digests:
        settings["recipe"] = (found.recipe_sha256[:12], job.method.digest[:12])
    for name, (theirs, ours) in settings.items():
        if theirs != ours:
            sentence = f"{folder.root} holds another run: its {name} is {theirs}, not {ours}."
            remedy = "Choose another --out, or delete that folder."
            raise InputError(sentence, f"{_same_data(found.data, job)} {remedy}" if name == "training data" else remedy)


def _same_data(found: Mapping[str, Any], job: Job) -> str:
    """Remedy for another start of the same photographs, which `compare` may have chosen; of other data in general."""
    ours = job.data.changes()
    start = found.get("init", TrainingData.init)
    same = {key: value for key, value in found.items() if key != "init"} == {k: v for k, v in ours.items() if k != "init"}
    return f"Add --set data.init={start}." if same else "Give the same --set data.KEY=VALUE."


def kept_scene(folder: RunFolder, name: str) -> Path | None:
    """Find the copy of a scene made in Python that lies in a run or in its comparison; ``None`` for other scenes.

    Args:
        folder: of the run.
        name: of the scene, as the run has it: the copy's path from where the fit was made.
    """
    if Path(name).name != SCENE_COPY:
        return None
    places = [folder.root, *itertools.islice(folder.root.absolute().parents, SHARED_ABOVE)]
    return next((place / SCENE_COPY for place in places if (place / SCENE_COPY).is_file()), None)


def _same_scene(folder: RunFolder, *names: str) -> bool:
    """Whether names are spellings of one scene: as copies in a run's folder, or as paths."""
    paths = [Path(name) for name in names]
    places = [path if path.exists() else kept_scene(folder, str(path)) or path for path in paths]
    existing = all(place.exists() for place in places) and not any(map(is_rendered, names))
    return len({place.resolve() if existing else os.path.normpath(place) for place in places}) == 1


def check_resumable(job: Job, scene: Scene, training_scene: Scene) -> None:
    """Check that a fit of another identity, which passed `check_replaceable`, may go on: that it is asked to be kept.

    Args:
        job: of the fit.
        scene: as loaded.
        training_scene: as the fit sees it.

    Raises:
        InputError: the folder's fit saw other pictures or cameras, has another name, or is not to be kept.
    """
    folder, method = job.folder, job.method.name
    found, other = folder.read(Provenance), "Choose another --out."
    if found.method != method:
        raise InputError(f"{folder.root} holds a run called '{found.method}', not '{method}'.", other)
    seen = (scene.digest("test"), training_scene.digest("train"), scene.camera_digest())
    if seen != (found.truth_sha256, found.train_sha256, found.cameras_sha256):
        raise InputError(f"{folder.root} holds a run of other pictures of the same scene.", other)
    if not job.request.keep:
        what = f"{folder.root} holds a run of other code, packages, threads or kernels, or from another source"
        made = f"it was made by {earlier_code(job)}; this is {code_version()}, {_threads(torch.get_num_threads())}"
        raise InputError(f"{what}: {made}.", f"Add --keep to go on with it. {other}")


def earlier_code(job: Job) -> str:
    """Code by which the folder's fit was made so far, in words: version of the sources, and plug-ins."""
    found = job.folder.read(Provenance)
    packages = ", ".join(sorted(set(found.plugins.values())))
    same = found.code_version == code_version()
    threads = "" if found.threads is None else f", {_threads(found.threads)}"
    ours = f"{'the same ' if same else ''}invgraphics{'' if same else f' {found.code_version}'}{threads}"
    return f"{ours} with {packages}" if packages else ours


def _threads(count: int) -> str:
    return f"{count} thread{'s' * (count != 1)}"


def _normalised(budget: str) -> str:
    """A budget in one spelling; as it stands where a run has another word for it (``imported``)."""
    try:
        return str(Budget.parse(budget))
    except InputError:
        return budget


def check_existing(job: Job) -> None:
    """Check that a job may use its folder: resume, reuse or replace the run there, or find none.

    Raises:
        InputError: it may not; the sentence says why.
    """
    folder, request = job.folder, job.request
    present = folder.has(Provenance)
    if request.existing == "refuse" and present:
        check_replaceable(job)
        if folder.finished:
            remedy = f"`invgraphics evaluate {folder.root}` scores it again; or choose another --out."
            raise InputError(f"{folder.root} holds this fit, finished.", remedy)
        raise InputError(f"{folder.root} holds this fit, unfinished.", "Add --resume to continue it, or choose another --out.")
    if request.existing == "resume" and not present:
        raise InputError(f"{folder.root} holds no run to resume.", "Leave out --resume to start one.")
    if request.existing != "refuse":
        check_replaceable(job)


def check_unused(folder: RunFolder) -> None:
    """Refuse a folder that holds a run.

    Raises:
        InputError: it does.
    """
    if folder.has(Provenance):
        raise InputError(f"{folder.root} already holds a run.", "Choose another --out.")


def check_truth(folder: RunFolder, scene: Scene, spec: str | None) -> None:
    """Check that a scene has the test views that a run was fitted beside: others may be its training photographs.

    Args:
        folder: of the run.
        scene: as opened.
        spec: the scene that was named in place of the run's own, if one was.

    Raises:
        InputError: pictures differ, or of a scene that is rendered, whose pixels another machine may round otherwise, cameras.
    """
    provenance = folder.read(Provenance)
    name = spec or provenance.scene
    if scene.digest("test") == provenance.truth_sha256:
        return
    if is_rendered(name) and scene.camera_digest() == provenance.cameras_sha256:
        return
    raise InputError(
        f"The test views of {name} are not those that {folder.root} was fitted beside; it may have been fitted to these.",
        "Give an unchanged copy of the scene, or fit again.",
    )


def cell_digest(job: Job) -> str:
    """Hash the settings of a study's cell, independent of machine and code version."""
    request = job.request
    scene = {"scene": os.path.normpath(request.scene)} | {key: getattr(request, key) for key in ("size", "test_views")}
    scene |= {} if request.spp is None else {"spp": request.spp}  # so that studies without keep their folders' names
    scene |= {"protocol": request.protocol}
    parts = {"method": job.method.name, "recipe": job.method.digest, "data": job.data.changes()}
    return sha256_of(_fit_settings(job) | scene | parts)


def _fit_settings(job: Job) -> dict[str, Any]:
    """Collect the request's settings that determine a fit; budgets and the default device are normalised."""
    device = job.request.device if job.device.type != "cpu" else None  # the default, so that studies keep their folders' names
    return {"seed": job.request.seed, "device": device, "kernels": job.request.kernels, "budget": str(job.budget)}
