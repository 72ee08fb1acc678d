"""The main job: several methods on one scene under one budget, each fit in its own process, one report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

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
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder
from invgraphics.scenes.degrade import degrade
from invgraphics.training.budget import Budget


def compare(request: CompareRequest) -> tuple[Path, int]:
    """Fit and evaluate every cell, then write ``compare.json`` for the report.

    Cells that an earlier, identical command finished are kept; one that it left half done goes on from its checkpoint.

    Returns:
        The comparison's folder, and how many cells failed.

    Raises:
        InputError: anything that cannot be used; found before the first fit.
        KeyboardInterrupt: interrupted; ``compare.json`` covers what is finished.
    """
    began = time.monotonic()
    scene = _validate(request)
    folder = RunFolder(Path(request.out))
    folder.create()
    failures: list[dict[str, Any]] = []
    summary = _summary(request, scene)
    interrupted = False
    try:
        with closing(LocalExecutor().run(request.fits(), folder.root / "jobs")) as outcomes:
            for outcome in outcomes:
                if outcome.status == INTERRUPTED:
                    raise KeyboardInterrupt
                if outcome.status != 0:
                    fit = outcome.request
                    failures.append({"method": fit.method, "seed": fit.seed, "error": outcome.error})
    except KeyboardInterrupt:
        interrupted = True
    done = [fit for fit in request.fits() if RunFolder(Path(fit.out)).finished]
    summary["runs"] = [Path(fit.out).relative_to(request.out).as_posix() for fit in done]
    summary["failures"] = failures
    summary["wall_seconds"] = round(time.monotonic() - began, 1)
    folder.write_json("compare.json", summary)
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
    return degrade(scene, data, request.seeds[0])


def _summary(request: CompareRequest, scene: Scene) -> dict[str, Any]:
    """Everything of ``compare.json`` that is known before the fits."""
    protocol = protocol_named(request.protocol)
    camera = scene.test[0].camera
    names, budget = ", ".join(request.methods), Budget.parse(request.budget)
    methods = [requested_method(name, request) for name in request.methods]
    notes = {protocol_note(method) for method in methods} - {""}
    return {
        "schema": 1,
        "scene": scene.name,
        "question": f"Given {budget} of optimisation each, how well do {names} show new views, at what cost?",
        "methods": list(request.methods),
        "summaries": {method.name: method.recipe.summary for method in methods},
        "seeds": list(request.seeds),
        "budget": request.budget,
        "size": [camera.width, camera.height],
        **_preset_facts(methods),
        "render_with": list(request.render_with),
        "command": request.shell(),
        "baselines": baseline_scores(scene, protocol),
        "noise_ceiling": scene.noise_ceiling,
        "protocol": protocol.record() | ({"test_poses": "; ".join(sorted(notes))} if notes else {}),
        "scene_info": {
            "train": len(scene.train),
            "val": len(scene.val),
            "test": len(scene.test),
            "colour": scene.colour,
            "background": scene.background.tolist(),
            "space": scene.bounds.space,
            "notes": scene.notes,
        },
        "environment": environment(torch.device(request.device or "cpu")),
    }


def _preset_facts(methods: Sequence[Method]) -> dict[str, Any]:
    """Which presets the fits take: the common one, empty where they differ; each method's; what chose them."""
    names = {method.name: method.preset for method in methods}
    choices = {method.preset_choice for method in methods}
    return {
        "preset": next(iter(names.values())) if len(set(names.values())) == 1 else "",
        "presets": names,
        "preset_choice": next(iter(choices)) if len(choices) == 1 else "",
        "preset_chosen_on": {method.name: list(method.chosen_on) for method in methods if method.chosen_on},
    }
