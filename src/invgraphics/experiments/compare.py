"""The main job: several methods on one scene under one budget, each fit in its own process, one report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import torch

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import device_of, open_requested, requested_method, training_data
from invgraphics.experiments.environment import environment
from invgraphics.experiments.executors.base import INTERRUPTED
from invgraphics.experiments.executors.local import LocalExecutor
from invgraphics.experiments.posed import protocol_note
from invgraphics.experiments.recorder import Cadence
from invgraphics.experiments.renderings import check_eyes
from invgraphics.experiments.request import CompareRequest
from invgraphics.metrics.baselines import baseline_scores
from invgraphics.metrics.protocols import protocol_named
from invgraphics.runs.comparison import ComparisonRecord, Failure, SceneFacts
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.scores import quality_of
from invgraphics.scenes.corrupt import corrupt
from invgraphics.training.budget import Budget


def compare(request: CompareRequest) -> tuple[Path, int]:
    """Fit and evaluate every cell, then write the comparison's record for the report.

    Cells that an earlier, identical command finished are kept; one that it left half done goes on from its checkpoint.

    Returns:
        The comparison's folder, and how many cells failed.

    Raises:
        InputError: anything that cannot be used; found before the first fit.
        KeyboardInterrupt: interrupted; the record covers what is finished.
    """
    began = time.monotonic()
    scene = _validate(request)
    folder = RunFolder(Path(request.out))
    folder.create()
    failures: list[Failure] = []
    summary = _summary(request, scene)
    interrupted = False
    try:
        with closing(LocalExecutor().run(request.fits(), folder.root / "jobs")) as outcomes:
            for outcome in outcomes:
                if outcome.status == INTERRUPTED:
                    raise KeyboardInterrupt
                if outcome.status != 0:
                    fit = outcome.request
                    failures.append(Failure(method=fit.method, seed=fit.seed, error=outcome.error))
    except KeyboardInterrupt:
        interrupted = True
    done = [fit for fit in request.fits() if RunFolder(Path(fit.out)).finished]
    runs = tuple(Path(fit.out).relative_to(request.out).as_posix() for fit in done)
    seconds = round(time.monotonic() - began, 1)
    folder.write(replace(summary, runs=runs, failures=tuple(failures), wall_seconds=seconds))
    if interrupted:
        raise KeyboardInterrupt
    return folder.root, len(failures)


def _validate(request: CompareRequest) -> Scene:
    """Look at everything that could be wrong before any time is spent."""
    if not request.methods:
        raise InputError("--methods is empty.", "Example: --methods volumetric/hash,splatting/gaussians.")
    if len(set(request.methods)) != len(request.methods) or len(set(request.seeds)) != len(request.seeds):
        raise InputError("A method or a seed is named twice.")
    Budget.parse(request.budget)
    Cadence.parse(request.checkpoint_every)
    device_of(request.device)
    protocol_named(request.protocol)
    methods = [requested_method(name, request) for name in request.methods]
    data = training_data(request)
    RunFolder(Path(request.out)).create()
    scene = open_requested(request)
    check_eyes(request.render_with, methods, scene)
    return corrupt(scene, data, request.seeds[0])


def _summary(request: CompareRequest, scene: Scene) -> ComparisonRecord:
    """Everything that is known before the fits."""
    protocol = protocol_named(request.protocol)
    camera = scene.test[0].camera
    names, budget = ", ".join(request.methods), Budget.parse(request.budget)
    methods = [requested_method(name, request) for name in request.methods]
    notes = {protocol_note(method) for method in methods} - {""}
    baselines = baseline_scores(scene, protocol)
    return ComparisonRecord(
        scene=scene.name,
        question=f"Given {budget} of optimisation each, how well do {names} show new views, at what cost?",
        methods=request.methods,
        summaries={method.name: method.recipe.summary for method in methods},
        seeds=request.seeds,
        budget=request.budget,
        size=(camera.width, camera.height),
        preset=_common([method.preset for method in methods]),
        presets={method.name: method.preset for method in methods},
        preset_choice=_common([method.preset_choice for method in methods]),
        preset_chosen_on={method.name: method.chosen_on for method in methods if method.chosen_on},
        render_with=request.render_with,
        command=request.shell(),
        baselines={name: quality_of(quality) for name, quality in baselines.items()},
        noise_ceiling=scene.noise_ceiling,
        protocol=asdict(protocol) | ({"test_poses": "; ".join(sorted(notes))} if notes else {}),
        scene_info=_scene_facts(scene),
        environment=environment(torch.device(request.device or "cpu")),
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


def _common(texts: Sequence[str]) -> str:
    """What all agree on; empty where they differ."""
    return texts[0] if len(set(texts)) == 1 else ""
