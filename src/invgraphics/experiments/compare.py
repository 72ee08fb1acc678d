"""The main job: several methods on one scene under one budget, each fit in its own process, one report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import open_with_progress
from invgraphics.experiments.environment import environment
from invgraphics.experiments.executors.base import INTERRUPTED
from invgraphics.experiments.executors.local import LocalExecutor
from invgraphics.experiments.job import Job
from invgraphics.experiments.posed import protocol_note
from invgraphics.experiments.renderings import check_variants
from invgraphics.experiments.request import CompareRequest
from invgraphics.metrics.baselines import baseline_scores
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder
from invgraphics.scenes.degrade import degrade


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
    jobs, scene = _resolve(request)
    folder = RunFolder(Path(request.out))
    folder.create()
    failures: list[dict[str, Any]] = []
    summary = _summary(request, jobs, scene)
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


def _resolve(request: CompareRequest) -> tuple[list[Job], Scene]:
    """A job of each method, with the first seed, and the scene as that one sees it.

    Raises:
        InputError: anything that could be wrong, before any time is spent.
    """
    if not request.methods:
        raise InputError("--methods is empty.", "Example: --methods volumetric/hash,splatting/gaussians.")
    if len(set(request.methods)) != len(request.methods) or len(set(request.seeds)) != len(request.seeds):
        raise InputError("A method or a seed is named twice.")
    jobs = [Job.of(fit) for fit in request.fits() if fit.seed == request.seeds[0]]
    RunFolder(Path(request.out)).create()
    scene = open_with_progress(request.scene, jobs[0].options)
    check_variants(jobs[0].variants, [job.method for job in jobs], scene)
    return jobs, degrade(scene, jobs[0].data, request.seeds[0])


def _summary(request: CompareRequest, jobs: Sequence[Job], scene: Scene) -> dict[str, Any]:
    """Everything of ``compare.json`` that is known before the fits."""
    protocol, budget = jobs[0].protocol, jobs[0].budget
    camera = scene.test[0].camera
    names = ", ".join(request.methods)
    methods = [job.method for job in jobs]
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
        "environment": environment(jobs[0].device),
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
