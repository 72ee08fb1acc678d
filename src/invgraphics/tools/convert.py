"""Conversion of a run to another parameterisation: a new run, scored as converted and again after a short refit."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from invgraphics.core import Model
from invgraphics.errors import InputError, did_you_mean
from invgraphics.experiments.build import build_plan, configure_torch, use_kernels
from invgraphics.experiments.clocks import fit_costs, fit_record
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.evaluate import evaluate, score_model
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.experiments.identity import check_unused
from invgraphics.experiments.job import Job
from invgraphics.experiments.recorder import Recorder
from invgraphics.experiments.request import DATA, FitRequest
from invgraphics.experiments.run import write_description
from invgraphics.metrics.cost import PeakMemory
from invgraphics.recipes.recipe import load_method
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import ConvertedRun, Provenance
from invgraphics.runs.scores import Scores
from invgraphics.scenes.degrade import degrade
from invgraphics.tables import inline_toml
from invgraphics.text import sha256_of
from invgraphics.tools.conversions import TARGETS, Target
from invgraphics.training.fit import Fit


@dataclass(frozen=True, kw_only=True)
class ConvertRequest:
    """A run, and what to make of it.

    Attributes:
        run: folder of the run.
        to: a name in `TARGETS`.
        out: folder of the new run.
        method: whose field is made and refitted; empty for the target's own.
        refit: budget of the refit, ``10s`` or ``500steps``.
        size: number of Gaussians, or of vertices or voxels along the longest edge of a lattice or of what a mesh is cut from;
            ``None`` for the target's own.
        overrides: ``key=value`` items laid over the method's recipe.
        seed: of sampling and refit.
        scene: another copy of the run's scene.
        kernels: implementation to force; ``None`` for the best one here.
    """

    run: Path
    to: str
    out: Path
    method: str = ""
    refit: str = "10s"
    size: int | None = None
    overrides: tuple[str, ...] = ()
    seed: int = 0
    scene: str | None = None
    kernels: str | None = None

    def __post_init__(self) -> None:
        if self.to not in TARGETS:
            raise InputError(f"--to cannot be '{self.to}'.{did_you_mean(self.to, TARGETS)}", f"Expected: {', '.join(TARGETS)}.")
        if self.size is not None and not (TARGETS[self.to].size and self.size >= 2):
            known = "Expected at least 2." if TARGETS[self.to].size else f"{self.to} has no size of its own; use --set."
            raise InputError(f"--size cannot be {self.size}.", known)

    @property
    def target(self) -> Target:
        """What the run becomes."""
        return TARGETS[self.to]

    def shell(self) -> str:
        """Shell command that repeats the conversion."""
        words = ["invgraphics", "convert", str(self.run), "--to", self.to, "--refit", self.refit, "--seed", str(self.seed)]
        words += ["--method", self.method] if self.method else []
        words += ["--size", str(self.size)] if self.size is not None else []
        words += [word for item in self.overrides for word in ("--set", item)]
        words += ["--scene", self.scene] if self.scene else []
        words += ["--kernels", self.kernels] if self.kernels else []
        return shlex.join([*words, "--out", str(self.out)])


@dataclass(frozen=True)
class Converted:
    """Result of a conversion.

    Attributes:
        folder: the new run.
        native: scores of the run that was converted.
        converted: scores as converted, before the refit.
        refitted: scores after it, those of the new run.
    """

    folder: RunFolder
    native: Scores
    converted: Scores
    refitted: Scores


def convert_run(request: ConvertRequest) -> Converted:
    """Convert a run, score the result, refit it, and write it as a run of its own.

    Raises:
        InputError: anything about the request or the run that cannot be used; nothing has been written then.
        NumericalError: the refit left the finite numbers.
    """
    fitted = open_fitted(request.run, request.scene)
    if fitted.poses is not None:
        sentence = f"{request.run} has refined its cameras' poses, which a converted run would not know."
        raise InputError(sentence, "Convert a run that was fitted without --optimise poses.")
    job = _job(request, fitted)
    folder = job.folder
    check_unused(folder)
    configure_torch(job.device)
    use_kernels(request.kernels, job.device)
    shown = degrade(fitted.scene, job.data, fitted.folder.read(Provenance).data_seed)
    plan = build_plan(job.method, shown, job.budget, request.seed, job.device)
    torch.manual_seed(request.seed)
    size = request.size or request.target.size
    field = request.target.convert(fitted.model, shown, job.method, size).to(job.device)
    plan = replace(plan, model=Model(field, plan.model.renderer, plan.model.bounds))
    native = fitted.folder.read_scores() if fitted.folder.finished else _scores(fitted.model, fitted, fitted.method.name)
    converted = _scores(plan.model, fitted, f"{job.method.name} as converted")
    folder.create()
    with folder.held():
        check_unused(folder)
        folder.clear()
        origin = _origin(request, fitted, native, converted)
        provenance = write_description(job, fitted.scene, shown, _identity(job, origin), plan)
        folder.write(replace(provenance, command=request.shell(), converted=origin, threads=torch.get_num_threads()))
        with PeakMemory(job.device) as memory:
            fit = Fit(plan)
            fit.warmup_step()
            Recorder(fit, folder, job.cadence, f"{job.method.name} refit").run()
        spent = replace(fit_record(fit.steps, fit.clocks()), peak_memory_bytes=memory.peak_bytes)
        folder.write(spent)
        refitted = evaluate(folder, fitted.scene, fit.plan.model, "default", fit_costs(spent), job.method)
    return Converted(folder, native, converted, refitted)


def _job(request: ConvertRequest, fitted: Fitted) -> Job:
    provenance, target = fitted.folder.read(Provenance), request.target
    size = request.size or target.size
    options = provenance.options
    # The refit sees the photographs that the fit saw.
    if request.method:
        field, usual = (load_method(name).recipe.field for name in (request.method, target.method))
        if type(field) is not type(usual):
            sentence = f"--method {request.method} has another field than --to {request.to} makes."
            raise InputError(sentence, f"Expected {target.method}, or a recipe with the same type of field.")
        _check_hooks(request, target)
    data = tuple(f"{DATA}{key}={inline_toml(value)}" for key, value in provenance.data.items())
    return Job.of(
        FitRequest(
            scene=request.scene or provenance.scene,
            out=str(request.out),
            method=request.method or target.method,
            budget=request.refit,
            overrides=tuple(item.format(size=size, run=request.run) for item in target.overrides) + data + request.overrides,
            size=options.size,
            test_views=options.test_views,
            spp=options.spp,
            seed=request.seed,
            device="cuda" if fitted.model.device.type == "cuda" else None,
            kernels=request.kernels,
        )
    )


def _check_hooks(request: ConvertRequest, target: Target) -> None:
    """Refuse a method that relies on a hook which a conversion's refit is without.

    Raises:
        InputError: names the hook.
    """
    hooks, usual = (
        {hook["type"] for hook in load_method(name).table.get("hooks", ())} for name in (request.method, target.method)
    )
    if request.to == "gaussians" and (own := sorted(hooks - usual)):
        sentence = f"--method {request.method} relies on its hook '{own[0]}', which converted Gaussians are refitted without."
        raise InputError(sentence, f"Convert to {target.method}, and start a fit from that: --set field.init=field.")


def _scores(model: Model, fitted: Fitted, title: str) -> Scores:
    return score_model(model, fitted.scene, "default", title)


def _origin(request: ConvertRequest, fitted: Fitted, native: Scores, converted: Scores) -> ConvertedRun:
    return ConvertedRun(
        run=str(request.run),
        cell_sha256=fitted.source.identity or "",
        method=fitted.method.name,
        to=request.to,
        hub=request.target.hub,
        native_psnr=native.quality["psnr"].mean,
        converted_psnr=converted.quality["psnr"].mean,
        data_seed=fitted.folder.read(Provenance).data_seed,
    )


def _identity(job: Job, origin: ConvertedRun) -> str:
    """Hash of everything that determines the new run's result."""
    parts = {"recipe": job.method.digest, "method": job.method.name, "converted": asdict(origin), "code": code_version()}
    request = {"budget": str(job.budget), "seed": job.request.seed, "kernels": job.request.kernels}
    return sha256_of(parts | request | {"threads": torch.get_num_threads()})
