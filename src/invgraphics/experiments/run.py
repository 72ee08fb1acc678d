"""One run: open the scene, build the method, fit, keep, evaluate."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

import torch

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments import recipe
from invgraphics.experiments.build import build_plan, device_of, repeatable, use_kernels
from invgraphics.experiments.environment import code_version, environment
from invgraphics.experiments.evaluate import evaluate, expected_seconds, save_truth
from invgraphics.experiments.folder import RunFolder, write_json
from invgraphics.experiments.recorder import Cadence, Recorder
from invgraphics.experiments.request import FitRequest
from invgraphics.metrics.cost import PeakMemory
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training import checkpoint
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit


def fit_run(request: FitRequest) -> Path:
    """Make the run that ``request`` describes; returns its folder.

    Raises:
        InputError: anything about the request or the folder that cannot be used; nothing has been computed then.
        KeyboardInterrupt: the run was interrupted and holds a checkpoint.
        NumericalError: the fit left the finite numbers; the history and the last checkpoint remain.
    """
    budget, cadence = Budget.parse(request.budget), Cadence.parse(request.checkpoint_every)
    method = recipe.load_method(request.method, request.preset, request.overrides)
    device = device_of(request.device)
    folder = RunFolder(Path(request.out))
    _check_existing(folder, request)
    repeatable(device)
    scene = open_scene(request.scene, SceneOptions(size=request.size, test_views=request.test_views))
    identity = _identity(request, method, scene)
    known = folder.read_json("provenance.json") if (folder.root / "provenance.json").is_file() else {}
    same = known.get("cell_sha256") == identity
    if request.existing == "resume" and known and not same:
        raise InputError(
            f"{folder.root} holds another run: its method, scene, budget, seed or code differ.", "Choose another --out."
        )
    if same and folder.finished:
        return folder.root
    use_kernels(request.kernels)
    with PeakMemory(device) as memory:
        fit = Fit(build_plan(method, scene, budget, request.seed, device))
        if same and folder.checkpoint.is_file():
            fit.load(checkpoint.load(folder.checkpoint, device), float(folder.read_json("fit.json")["seconds"]))
            folder.cut_history(fit.steps)
        else:
            folder.clear()
        _describe(folder, request, method, scene, identity, device)
        fit.rehearse()
        print(_prediction(request, fit), file=sys.stderr)
        Recorder(fit, folder, cadence, f"{method.name} seed {request.seed}").run()
    costs = {"fit_seconds": fit.seconds, "steps": fit.steps, "peak_memory_bytes": memory.peak_bytes}
    folder.write_json("fit.json", {"steps": fit.steps, "seconds": fit.seconds, "peak_memory_bytes": memory.peak_bytes})
    evaluate(folder, scene, (fit.plan.field, fit.plan.renderer), request.protocol, costs, method)
    return folder.root


def _check_existing(folder: RunFolder, request: FitRequest) -> None:
    present = (folder.root / "provenance.json").is_file()
    if request.existing == "refuse" and present:
        raise InputError(f"{folder.root} already holds a run.", "Add --resume to go on with it, or choose another --out.")
    if request.existing == "resume" and not present:
        raise InputError(f"{folder.root} holds no run to resume.", "Leave --resume away to start one.")
    folder.create()


def _prediction(request: FitRequest, fit: Fit) -> str:
    """What the person is in for, said before the work starts."""
    views = len(fit.plan.scene.test)
    seconds = expected_seconds(fit.plan.field, fit.plan.renderer, fit.plan.scene, fit.plan.device)
    evaluation = f"{views} test views in at most about {seconds:.0f} s"
    return f"{request.method} on {fit.plan.scene.name}: fit {fit.plan.budget}, then {evaluation}."


def _identity(request: FitRequest, method: recipe.Method, scene: Scene) -> str:
    """SHA-256 of everything that decides a run's result."""
    parts: dict[str, Any] = {
        "method": method.name,
        "recipe": method.digest,
        "truth": [scene.digest("train"), scene.digest("val"), scene.digest("test")],
        "cameras": scene.camera_digest(),
        "request": {key: getattr(request, key) for key in ("budget", "seed", "device", "kernels", "protocol")},
        "code": code_version(),
        "threads": torch.get_num_threads(),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _describe(
    folder: RunFolder, request: FitRequest, method: recipe.Method, scene: Scene, identity: str, device: torch.device
) -> None:
    """Write what can be known before the fit."""
    folder.write_recipe(method.table)
    folder.write_json("environment.json", environment(device))
    truth_root = Path(request.truth) if request.truth else folder.root / "truth"
    truth = save_truth(scene, truth_root)
    provenance = {
        "schema": 1,
        "cell_sha256": identity,
        "method": method.name,
        "preset": method.preset,
        "recipe_sha256": method.digest,
        "scene": request.scene,
        "seed": request.seed,
        "budget": request.budget,
        "truth_sha256": scene.digest("test"),
        "train_sha256": scene.digest("train"),
        "cameras_sha256": scene.camera_digest(),
        "truth": Path(*_relative(truth, folder.root)).as_posix(),
        "background": scene.background.tolist(),
        "colour": scene.colour,
        "notes": scene.notes,
        "code_version": code_version(),
        "command": request.shell(),
        "options": {"size": request.size, "test_views": request.test_views},
        "device": str(device),
    }
    folder.write_json("provenance.json", provenance)


def _relative(target: Path, start: Path) -> tuple[str, ...]:
    return Path(os.path.relpath(target, start)).parts


def work(job: Path) -> int:
    """Make the run of a JSON job file in this process; the exit status says how it went (see `compare`)."""
    try:
        fit_run(FitRequest.from_json(json.loads(job.read_text())))
    except KeyboardInterrupt:
        return 130
    except Exception as error:  # a cell that fails is a result: its sentence goes into the report
        write_json(job.with_suffix(".error.json"), {"kind": type(error).__name__, "error": str(error)})
        if not isinstance(error, InputError):
            traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(work(Path(sys.argv[1])))
