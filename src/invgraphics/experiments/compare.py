"""Comparison of several methods on one scene under one budget: each fit in its own process, one report."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import torch

from invgraphics import plugins
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, open_with_progress
from invgraphics.experiments.compare_folders import any_finished, check_folders, made_before, missing_fits, name_others
from invgraphics.experiments.environment import environment
from invgraphics.experiments.evaluate import scene_as_trained
from invgraphics.experiments.executors.local import LocalExecutor
from invgraphics.experiments.identity import check_replaceable
from invgraphics.experiments.job import Job
from invgraphics.experiments.posed import exposure_note, protocol_note
from invgraphics.experiments.renderings import check_variants
from invgraphics.experiments.request import DATA, CompareRequest
from invgraphics.experiments.start import check_source
from invgraphics.interruption import INTERRUPTED
from invgraphics.metrics.baselines import baseline_scores
from invgraphics.recipes.suitable import default_methods, is_open_space, starts_from_points
from invgraphics.recipes.table import cell_of
from invgraphics.runs.comparison import ComparisonRecord, Failure, Refusal, SceneFacts
from invgraphics.runs.folder import RunFolder, output_folder
from invgraphics.scenes.degrade import degrade
from invgraphics.scenes.open import SceneOptions, space_note
from invgraphics.scenes.truth import POINTS as EXACT_POINTS
from invgraphics.text import common_value

START = f"{DATA}init"
MOST_NAMES = 6
"""Methods that the question of a comparison names; of more only the number is given."""


def compare(request: CompareRequest) -> tuple[Path, int]:
    """Fit and evaluate every cell, then write the comparison's record for the report.

    Cells that an earlier, identical command finished are kept, with ``request.keep`` those of earlier code too; one that it
    left half done goes on from its checkpoint.

    Returns:
        The comparison's folder, and how many cells failed.

    Raises:
        InputError: anything that cannot be used; found before the first fit.
        KeyboardInterrupt: interrupted; the record covers what is finished.
    """
    with output_folder(Path(request.out)):
        return _compare(request)


def _compare(request: CompareRequest) -> tuple[Path, int]:
    began = time.monotonic()
    request, choice, opened = (request, "", None) if request.methods else _choose_methods(request)
    if opened is None and any_finished(request):
        opened = open_with_progress(request.scene, SceneOptions(request.size, request.test_views, spp=request.spp))
    request, jobs, scenes, refused = _resolve(request, opened)
    folder = RunFolder(Path(request.out))
    failures: list[Failure] = []
    name_others(request)
    earlier, made = any_finished(request), made_before(request, jobs, opened)
    summary = replace(_summary(request, jobs, *scenes), refused=tuple(refused), method_choice=choice)
    interrupted: KeyboardInterrupt | None = None
    try:
        with closing(LocalExecutor().run(missing_fits(request, jobs), folder.root / "jobs")) as outcomes:
            for outcome in outcomes:
                if outcome.status == INTERRUPTED:
                    raise KeyboardInterrupt
                fit = outcome.request
                made.add(fit.out)
                if outcome.status != 0:
                    failures.append(Failure(method=fit.method, seed=fit.seed, error=outcome.error))
    except KeyboardInterrupt as error:
        interrupted = error
    failed = {(failure.method, failure.seed) for failure in failures}
    ended = [fit for fit in request.fits() if fit.out in made and (fit.method, fit.seed) not in failed]
    done = [fit for fit in ended if RunFolder(Path(fit.out)).finished]
    runs = tuple(Path(fit.out).relative_to(request.out).as_posix() for fit in done)
    seconds = None if earlier else round(time.monotonic() - began, 1)
    folder.write(replace(summary, runs=runs, failures=tuple(failures), wall_seconds=seconds))
    if interrupted is not None:
        raise interrupted
    return folder.root, len(failures)


def _choose_methods(request: CompareRequest) -> tuple[CompareRequest, str, Scene]:
    """Choose the methods of a request that names none by its scene, and print them; returns the choice in words, and the scene.

    Raises:
        InputError: the scene cannot be opened.
    """
    scene = open_with_progress(request.scene, SceneOptions(request.size, request.test_views, spp=request.spp))
    methods, reason = default_methods(scene)
    print(f"Methods: {', '.join(methods)}, chosen for {reason}; --methods overrides.{space_note(scene)}", file=sys.stderr)
    return replace(request, methods=methods), f"chosen for {reason}", scene


def _resolve(
    request: CompareRequest, opened: Scene | None = None
) -> tuple[CompareRequest, list[Job], tuple[Scene, Scene], list[Refusal]]:
    """Resolve one job per method with the first seed, and open the scene with that seed's data degradation.

    Args:
        request: with its methods.
        opened: its scene, where it is open already.

    Returns:
        The request without the optional methods that do not go with the scene; its jobs; the scene as loaded, and degraded; the
        refused methods.

    Raises:
        InputError: anything that could be wrong, before any time is spent.
    """
    for what, named in (("method", request.methods), ("seed", request.seeds)):
        if twice := [one for one, count in Counter(named).items() if count > 1]:
            raise InputError(f"The {what} '{twice[0]}' is named twice.", "Name it once.")
    check_folders(request)
    jobs, refused = _jobs(request)
    full = opened or open_with_progress(request.scene, jobs[0].options)
    if start := _start_for_all(request, jobs, full):
        points = f"Points to start from are found in the training photographs ({start})"
        print(f"{points}; --set data.init=scene|random overrides.", file=sys.stderr)
        request = replace(request, overrides=(*request.overrides, start))
        jobs = [Job.of(replace(job.request, overrides=request.overrides), job.method) for job in jobs]
    methods = {job.request.method: job.method for job in jobs}
    for fit in request.fits():
        if fit.method in methods:
            check_replaceable(Job.of(fit, methods[fit.method]), None if request.keep else torch.get_num_threads())
    scene = degrade(full, jobs[0].data, request.seeds[0])
    jobs, unsuitable = _suitable(request, jobs, scene)
    request = replace(request, methods=tuple(job.request.method for job in jobs))
    check_variants(jobs[0].variants, [job.method for job in jobs], full)
    return request, jobs, (full, scene), [*refused, *unsuitable]


def _jobs(request: CompareRequest) -> tuple[list[Job], list[Refusal]]:
    """Resolve one job per method with the first seed; returns the jobs and the methods that cannot be used.

    Raises:
        InputError: a method that is not optional cannot be used, or none can.
    """
    jobs, refused = [], []
    for fit in request.fits():
        if fit.seed == request.seeds[0]:
            try:
                jobs.append(Job.of(fit))
            except InputError as error:
                refused.append(_refusal(request, fit.method, error))
    if not jobs:
        raise InputError("None of the methods can be used.", f"{refused[0].method}: {refused[0].reason}")
    return jobs, refused


def _start_for_all(request: CompareRequest, jobs: Sequence[Job], scene: Scene) -> str:
    """Override that gives methods points from the photographs to start from; empty where request or scene decide otherwise.

    Points of a rendered scene are exact: no method could find them, and most have no use for them. In an open space all have
    (see `invgraphics.training.views.sparse_depth`), and some data sets come without any.
    """
    if any(item.partition("=")[0] == START for item in request.data_overrides):
        return ""
    exact = scene.notes.get("points") == EXACT_POINTS and any(starts_from_points(job.method.table) for job in jobs)
    return f"{START}=sfm" if exact or (is_open_space(scene) and scene.points is None) else ""


def _suitable(request: CompareRequest, jobs: Sequence[Job], scene: Scene) -> tuple[list[Job], list[Refusal]]:
    """Build every method's model, and separate the optional methods that refuse the scene.

    Raises:
        InputError: one that is not optional does, or all of them do.
    """
    kept, refused = [], []
    for job in jobs:
        try:
            plugins.check_importable(job.method.table, job.method.name)
            check_source(job.method, request.scene)
            build_model(job.method, scene, request.seeds[0], job.device)
        except InputError as error:
            refused.append(_refusal(request, job.request.method, error))
        else:
            kept.append(job)
    if not kept:
        raise InputError("None of the methods goes with the scene.", f"{refused[0].method}: {refused[0].reason}")
    return kept, refused


def _refusal(request: CompareRequest, method: str, error: InputError) -> Refusal:
    """Record of an optional method's refusal; raises the error of any other, with its name."""
    if method not in request.optional:
        sentence = error.sentence if method in error.sentence else f"{method}: {error.sentence}"
        remedy = error.remedy
        if error.sentence.startswith("Unknown key") and len(request.methods) > 1:
            remedy += "\nA key of one method only is part of its name: --methods METHOD:KEY=VALUE,OTHER."
        raise InputError(sentence, remedy) from error
    return Refusal(method=method, reason=error.sentence)


def _summary(request: CompareRequest, jobs: Sequence[Job], full: Scene, scene: Scene) -> ComparisonRecord:
    """Make the comparison's record, without its runs: scene, methods, protocol, baselines and environment.

    Baselines are scored like the fits, over the background of the scene as loaded.
    """
    protocol, budget = jobs[0].protocol, jobs[0].budget
    camera = scene.test[0].camera
    names = ", ".join(request.methods) if len(request.methods) <= MOST_NAMES else f"{len(request.methods)} methods"
    methods = [job.method for job in jobs]
    notes = {
        "test_poses": {protocol_note(method) for method in methods} - {""},
        "test_exposure": _of_methods({method.name: exposure_note(method, scene) for method in methods}),
    }
    baselines = baseline_scores(scene_as_trained(full, jobs[0].data.changes(), request.seeds[0]), protocol)
    return ComparisonRecord(
        scene=scene.name,
        question=f"Given {budget} of optimisation each, how well do {names} show new views, at what cost?",
        methods=request.methods,
        summaries={method.name: method.recipe.summary for method in methods},
        cells={method.name: cell_of(method.table) for method in methods},
        seeds=request.seeds,
        budget=request.budget,
        size=(camera.width, camera.height),
        preset=common_value([method.preset for method in methods]),
        presets={method.name: method.preset for method in methods},
        preset_choice=common_value([method.preset_choice for method in methods]),
        preset_chosen_on={method.name: method.chosen_on for method in methods if method.chosen_on},
        render_with=request.render_with,
        command=replace(request, keep=False).shell(),
        baselines=baselines,
        noise_ceiling=scene.noise_ceiling,
        protocol=protocol.record() | {key: "; ".join(sorted(found)) for key, found in notes.items() if found},
        scene_info=_scene_facts(replace(scene, background=full.background)),
        environment=environment(jobs[0].device),
        runs=(),
    )


def _scene_facts(scene: Scene) -> SceneFacts:
    red, green, blue = scene.background.tolist()
    return SceneFacts(
        train=len(scene.train),
        val=len(scene.val),
        test=len(scene.test),
        colour=scene.colour,
        background=(red, green, blue),
        space=scene.bounds.space,
        notes=scene.notes,
    )


def _of_methods(notes: Mapping[str, str]) -> set[str]:
    """Notes with the method that each is about; the note alone where all methods have the same."""
    common = common_value(list(notes.values()))
    return {common} - {""} if common else {f"{method}: {note}" for method, note in notes.items() if note}
