"""Fitting in this process, and scoring."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Literal, overload

from invgraphics.api.loading import MethodLike, as_scene, reopenable_scene, resolved
from invgraphics.core import Model, Scene
from invgraphics.experiments.evaluate import score_model
from invgraphics.experiments.fitted import load_fitted
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import make_run
from invgraphics.experiments.session import FolderRun, MemoryRun, OnStep, ScoreTable
from invgraphics.interruption import Terminated
from invgraphics.runs.folder import RECIPE, RunFolder
from invgraphics.scenes.open import source_of


@overload
def fit(
    method: MethodLike,
    scene: Scene | str,
    budget: str = ...,
    *,
    seed: int = ...,
    out: None = ...,
    device: Literal["cpu", "cuda"] | None = ...,
    snapshots: int = ...,
    on_step: OnStep | None = ...,
) -> MemoryRun: ...
@overload
def fit(
    method: MethodLike,
    scene: Scene | str,
    budget: str = ...,
    *,
    seed: int = ...,
    out: str | os.PathLike[str],
    device: Literal["cpu", "cuda"] | None = ...,
    snapshots: int = ...,
    on_step: OnStep | None = ...,
) -> FolderRun: ...
def fit(
    method: MethodLike,
    scene: Scene | str,
    budget: str = "60s",
    *,
    seed: int = 0,
    out: str | os.PathLike[str] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    snapshots: int = 0,
    on_step: OnStep | None = None,
) -> MemoryRun | FolderRun:
    """Fit a method to a scene in this process, with a progress bar.

    Ctrl-C, or a notebook's stop button, ends the fit after a whole step and returns it as it is. Without ``out``,
    `MemoryRun.resume` goes on; with ``out``, the same call goes on from the folder's checkpoint, and opens what is finished.

    Args:
        method: name, path of a recipe, table, or loaded method.
        scene: loaded, made in Python, or what `load_scene` opens.
        budget: seconds of optimisation (``60s``, ``2m``, ``1h``) or steps (``5000steps``).
        seed: of the initial values and of the fit.
        out: folder that keeps the run as ``invgraphics fit`` does, scores included; ``None`` keeps it in memory.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        snapshots: states of the model that ``out`` keeps for a time-lapse, evenly over the fit, besides the first.
        on_step: is given the fit before its first step and after each one, on no clock: ``fit.steps``, ``fit.seconds``,
            ``fit.progress``, ``fit.model``, ``fit.plan``.

    Raises:
        InputError: something cannot be used, or ``out`` holds another run; nothing has been computed then.
        NumericalError: the fit left the finite numbers.

    Example:
        >>> import invgraphics as ig
        >>> scene = ig.load_scene("toy.npz", size=16)
        >>> fit = ig.fit("splatting/gaussians", scene, budget="20steps")
        >>> picture = fit.model.render(scene.test[0].camera)
        >>> picture.rgb.shape, fit.finished, fit.history[-1].step
        (torch.Size([16, 16, 3]), True, 20)
    """
    scene = as_scene(scene)
    if out is None:
        source = source_of(scene)
        name, table = resolved(method, budget)
        where = scene.name if source is None else source.spec
        request = FitRequest(method=name, scene=where, out="", budget=budget, seed=seed, device=device)
        return MemoryRun(Job.of(request, table), scene, on_step)
    folder = RunFolder(Path(out))
    folder.create()
    existing: Literal["resume", "refuse"] = "resume" if folder.identity else "refuse"
    name, table = resolved(method, budget, str(folder.root / RECIPE))  # which the run writes, once the folder is its own
    settings: dict[str, Any] = {"budget": budget, "seed": seed, "device": device, "snapshots": snapshots}
    scene, place = reopenable_scene(scene, folder.root)
    request = FitRequest(method=name, out=str(out), existing=existing, **settings, **place)
    try:
        make_run(Job.of(request, table), scene, on_step)
    except KeyboardInterrupt as error:
        if isinstance(error, Terminated) or not folder.resumable:
            raise
        print(f"Interrupted; the same call continues from {folder.root}.", file=sys.stderr)
    return FolderRun(load_fitted(folder, scene))


def evaluate(model: Model, scene: Scene | str, protocol: str = "default") -> ScoreTable:
    """Render a scene's test views and score them by the rules of the command line.

    Args:
        model: any field and renderer.
        scene: loaded, made in Python, or what `load_scene` opens.
        protocol: ``default`` (pictures rounded to 8 bits) or ``float``.

    Raises:
        InputError: the scene or the protocol cannot be used.

    Example:
        >>> import invgraphics as ig
        >>> scene = ig.load_scene("toy.npz", size=16)
        >>> scores = ig.evaluate(ig.fit("splatting/gaussians", scene, budget="20steps").model, scene)
        >>> scores["psnr"] == sum(scores.per_view("psnr")) / len(scene.test), scores.unit("psnr")
        (True, 'dB')
    """
    scene = as_scene(scene)
    title = f"{type(model.field).__name__} through {type(model.renderer).__name__}"
    return ScoreTable(score_model(model, scene, protocol, title))
