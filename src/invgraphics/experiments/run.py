"""One run: open the scene, build the model, fit, write the run folder, evaluate."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch

from invgraphics import kernels, plugins
from invgraphics.core import Scene
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.build import build_plan, configure_torch, open_with_progress, use_kernels
from invgraphics.experiments.clocks import disturbance, fit_costs, fit_record, load_average
from invgraphics.experiments.environment import begun_by, code_version, continued, environment
from invgraphics.experiments.evaluate import evaluate, evaluate_saved, expected_seconds, save_truth
from invgraphics.experiments.identity import (
    check_existing,
    check_resumable,
    check_truth,
    earlier_code,
    run_digest,
    truth_digest,
)
from invgraphics.experiments.job import Job, make_training_scene, region_of
from invgraphics.experiments.posed import exposure_note, protocol_note, sparse_depth_note
from invgraphics.experiments.progress import warn
from invgraphics.experiments.recorder import Monitor, Recorder, cut_snapshots
from invgraphics.experiments.renderings import check_variants, is_kept_fit, render_missing
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.start import MemoryForecast, check_losses, initialise_field, memory_forecast, remove_empty, resume
from invgraphics.files import file_fault
from invgraphics.interruption import INTERRUPTED, Terminated, end_on_sigterm, end_with_parent
from invgraphics.metrics.cost import PeakMemory
from invgraphics.recipes.presets import announcements
from invgraphics.recipes.recipe import Method
from invgraphics.recipes.suitable import suggestion
from invgraphics.runs.environment import Environment
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import TRUTH, RunFolder
from invgraphics.runs.provenance import LoadAverage, Options, Provenance
from invgraphics.runs.schema import write_json
from invgraphics.scenes.open import selection_notes, space_note
from invgraphics.tables import read_json
from invgraphics.text import duration
from invgraphics.thread_pools import usable_cores
from invgraphics.training.fit import Fit, Plan


def fit_run(request: FitRequest) -> Path:
    """Fit and evaluate the run that ``request`` describes; returns its folder.

    Raises:
        InputError, KeyboardInterrupt, NumericalError: as `make_run`.
    """
    job = Job.of(request)
    make_run(job)
    return job.folder.root


def make_run(job: Job, scene: Scene | None = None, on_step: Callable[[Fit], None] | None = None) -> None:
    """Fit and evaluate a run in its folder; an existing run is kept, resumed or replaced, as requested.

    Args:
        job: of the run.
        scene: that the job names, where it is open already.
        on_step: is given the fit before its first step and after each one.

    Raises:
        InputError: anything about the request or the folder that cannot be used; nothing has been computed then.
        KeyboardInterrupt: the run was interrupted and holds a checkpoint.
        NumericalError: the fit left the finite numbers; the history and the last checkpoint remain.
    """
    if job.request.existing == "resume":
        check_existing(job)  # before the folder is made
    new = not job.folder.root.exists()
    job.folder.create()
    try:
        _make_run(job, scene, on_step)
    except InputError:
        if new:
            remove_empty(job.folder.root)
        raise


def _make_run(job: Job, scene: Scene | None, on_step: Callable[[Fit], None] | None) -> None:
    folder, method, request = job.folder, job.method, job.request
    configure_torch(job.device)
    with folder.held(wait=request.existing == "reuse"):  # by a child of a killed comparison or study, which is about to end
        check_existing(job)
        kernels.use(request.kernels)  # also for the scores and renderings of a fit that is finished
        scene = scene or open_with_progress(request.scene, job.options)
        check_variants(job.variants, [method], scene)
        training_scene = make_training_scene(job, scene)
        identity = run_digest(job, truth_digest(scene), torch.get_num_threads())
        same, other_code = folder.identity == identity, ""
        if request.existing == "resume" and folder.identity and not same:
            check_resumable(job, scene, training_scene)
            other_code, same = earlier_code(job), True
        if request.existing == "reuse" and request.keep and not same and is_kept_fit(job):
            check_truth(folder, scene, request.scene)
            same = True
        if same and folder.finished:
            for protocol in job.unscored():
                evaluate_saved(folder, scene, protocol)
            render_missing(job, scene)
            return
        use_kernels(request.kernels, job.device)
        began_at = load_average()
        with PeakMemory(job.device) as memory:
            fit = prepare(job, training_scene, scene)
            resumed = same and folder.resumable
            earlier = resume(fit, job) if resumed else None
            forecast = warm_up(fit, method, memory)  # which may refuse: the folder is as it was until then
            if earlier is not None:
                memory.include(earlier.peak_memory_bytes or 0)
                folder.cut_history(fit.steps)
                cut_snapshots(folder, fit.steps)
            else:
                folder.clear()
            before = folder.read(Environment) if earlier is not None and folder.has(Environment) else None
            if before is not None and other_code:
                before = begun_by(before, other_code)
            described = write_description(job, scene, training_scene, identity, fit.plan, before)
            folder.write(replace(described, memory_forecast_bytes=forecast.bytes))
            if "inconsistent_poses" in scene.notes:
                warn(f"SUSPICIOUS poses: {scene.notes['inconsistent_poses']}")
            with memory.excluding():  # pictures that are rendered to forecast the evaluation's time are no part of the fit
                prediction = _prediction(job, scene, fit, forecast)
            for sentence in (*announcements([method.choice]), prediction):
                print(sentence, file=sys.stderr)
            title = f"{method.name} seed {request.seed}"
            Recorder(fit, folder, job.cadence, title, request.snapshots, on_step, memory).run()
        load = LoadAverage(start=began_at, end=load_average())
        spent = replace(fit_record(fit.steps, fit.clocks(), memory.peak_bytes), cores=usable_cores(), load_average=load)
        _declare_clocks(folder, spent)
        _evaluate(job, scene, fit, spent)
        render_missing(job, scene)


def prepare(job: Job, training_scene: Scene, scene: Scene) -> Fit:
    """Build a job's fit, before its first step, on the degraded training data of a scene as loaded.

    Raises:
        InputError: method and scene do not go together, or what the method starts from cannot be used.
    """
    plan = build_plan(job.method, training_scene, job.budget, job.request.seed, job.device)
    return Fit(initialise_field(plan, job.method, job.request.scene, scene))


def warm_up(fit: Fit, method: Method, memory: PeakMemory) -> MemoryForecast:
    """Run a discarded warm-up step and monitor pass, and forecast the fit's memory from their peak.

    Warns of losses that have nothing to act on.

    Raises:
        InputError: no loss has, or the primitives would need more memory than the machine has.
    """
    fit.warmup_step()
    check_losses(fit, method)
    Monitor(fit.plan.scene, fit.plan.device).psnr(fit)
    return memory_forecast(fit.plan, method, memory.peak_bytes)


def _prediction(job: Job, loaded: Scene, fit: Fit, memory: MemoryForecast) -> str:
    """Forecast the fit's budget, memory and evaluation time in one sentence, before the fit starts; notes follow, on lines."""
    views = len(fit.plan.scene.test)
    seconds = expected_seconds(fit.plan.model, fit.plan.scene)
    evaluation = f"{views} test views in at most about {duration(seconds)}"
    scene = fit.plan.scene
    advice = suggestion(job.method, scene)
    notes = selection_notes(scene) + space_note(loaded) + (f"\n  try also: {advice}" if advice else "")
    notes += _region_note(scene) + _exposures_note(job.method, scene) + _depth_note(job.method, fit.plan)
    return f"{job.method.name} on {scene.name}: fit {fit.plan.budget}{memory}, then {evaluation}.{notes}"


def _region_note(scene: Scene) -> str:
    """Announce, on a line, a box that silhouettes made smaller; empty where they did not."""
    region = scene.notes.get("region")
    return f"\n  region: {region}, unless --set data.box=scene" if region else ""


def _exposures_note(method: Method, scene: Scene) -> str:
    """Announce, on a line, exposures that are fitted because the photographs differ in them; empty where they are not."""
    configured = method.recipe.training is not None and method.recipe.training.exposure is not None
    if configured or not exposure_note(method, scene):
        return ""
    return f"\n  exposures: {scene.notes['exposures']}; fitted too, unless --set training.exposure.optimise=false"


def _depth_note(method: Method, plan: Plan) -> str:
    """Announce, on a line, depths that are supervised because the photographs came with points; empty where they are not."""
    configured = method.recipe.training is not None and method.recipe.training.sparse_depth is not None
    what = sparse_depth_note(plan)
    return "" if configured or not what else f"\n  depth: {what}, unless --set training.sparse_depth.weight=0"


def _declare_clocks(folder: RunFolder, spent: FitRecord) -> None:
    """Write the system load to the run's provenance, and warn where other processes disturbed the timings."""
    folder.write(replace(folder.read(Provenance), threads=torch.get_num_threads(), load_average=spent.load_average))
    if disturbed := disturbance(fit_costs(spent)):
        warn(f"The fit {disturbed}. Its times are not to be compared.")


def _evaluate(job: Job, scene: Scene, fit: Fit, spent: FitRecord) -> None:
    """Score the fit on the scene as loaded. The default protocol's scores are last: they mark the run as finished."""
    job.folder.write(spent)
    for protocol in job.protocols:
        evaluate(job.folder, scene, fit.plan.model, protocol, fit_costs(spent), job.method, fit.plan.poses)


def write_description(
    job: Job, scene: Scene, training_scene: Scene, identity: str, plan: Plan | None = None, before: Environment | None = None
) -> Provenance:
    """Write the run's recipe, environment and truth; return its provenance as known before the fit.

    Args:
        job: of the run.
        scene: as loaded.
        training_scene: as the fit sees it.
        identity: of the run.
        plan: of the fit; ``None`` for none.
        before: where the part of the fit that is resumed was made; ``None`` where it starts here.
    """
    request, method, folder = job.request, job.method, job.folder
    folder.write_recipe(method.table)
    folder.write(continued(environment(job.device), before))
    truth = save_truth(scene, Path(request.truth) if request.truth else folder.root / TRUTH)
    red, green, blue = scene.background.tolist()
    return Provenance(
        cell_sha256=identity,
        method=method.name,
        preset=method.preset,
        preset_choice=method.preset_choice,
        preset_chosen_on=method.chosen_on,
        recipe_sha256=method.digest,
        scene=request.scene,
        seed=request.seed,
        budget=request.budget,
        truth_sha256=scene.digest("test"),
        train_sha256=training_scene.digest("train"),
        cameras_sha256=scene.camera_digest(),
        truth=Path(*_relative(truth, folder.root)).as_posix(),
        background=(red, green, blue),
        colour=scene.colour,
        data=job.data.changes(),
        notes=training_scene.notes,
        code_version=code_version(),
        plugins=plugins.used_plugins(method.table, method.name),
        command=request.shell(),
        options=Options(size=request.size, test_views=request.test_views, spp=request.spp),
        region=region_of(training_scene),
        device=str(job.device),
        test_poses=protocol_note(method),
        test_exposure=exposure_note(method, training_scene),
        sparse_depth="" if plan is None else sparse_depth_note(plan),
    )


def _relative(target: Path, start: Path) -> tuple[str, ...]:
    return Path(os.path.relpath(target, start)).parts


def _words(error: Exception) -> str:
    """An error in words: its own, of those that are written for users; else its kind and, where a plug-in raised it, which."""
    if isinstance(error, InputError | NumericalError):
        return str(error)
    what, fault = plugins.unexpected(error)
    return f"{what} ({fault[0].lower()}{fault[1:]})"


def work(job: Path) -> int:
    """Run the fit of a JSON job file in this process; returns its exit status (see `executors.local`)."""
    try:
        fit_run(FitRequest.from_json(read_json(job)))
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:  # a cell that fails is a result: its sentence goes into the report
        if Terminated.raised:  # a library made its own exception of it
            return INTERRUPTED
        fault = file_fault(error) or error
        with suppress(InputError, OSError):  # the disk that is full may be this one, and the folder that may not be written
            write_json(job.with_suffix(".error.json"), {"kind": type(fault).__name__, "error": _words(fault)})
        if not isinstance(fault, InputError):
            traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    end_on_sigterm()
    end_with_parent()
    sys.exit(work(Path(sys.argv[1])))
