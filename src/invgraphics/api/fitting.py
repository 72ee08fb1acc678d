"""Fitting in this process, and scoring."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack, overload

from invgraphics.api.keeping import reopenable_scene
from invgraphics.api.loading import MethodLike, as_scene, data_overrides, resolved, whole_seeds
from invgraphics.core import Model, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.display import ScoreTable
from invgraphics.experiments.evaluate import score_model
from invgraphics.experiments.fitted import load_fitted
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import make_run
from invgraphics.experiments.session import FittedRun, FolderRun, MemoryRun, OnStep
from invgraphics.interruption import Terminated
from invgraphics.runs.folder import RECIPE, RunFolder
from invgraphics.scenes.open import source_of


class FolderOptions(TypedDict, total=False):
    """Options of a fit that keeps a run folder.

    Attributes:
        snapshots: states of the model, for a time-lapse.
        keep: whether an unfinished fit goes on although code, threads or packages have changed since.
    """

    snapshots: int
    keep: bool


@overload
def fit(
    method: MethodLike,
    scene: Scene | str,
    budget: str = ...,
    *,
    seed: int = ...,
    out: None = ...,
    device: Literal["cpu", "cuda"] | None = ...,
    data: Mapping[str, Any] | None = ...,
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
    data: Mapping[str, Any] | None = ...,
    on_step: OnStep | None = ...,
    **kept: Unpack[FolderOptions],
) -> FolderRun: ...
def fit(
    method: MethodLike,
    scene: Scene | str,
    budget: str = "60s",
    *,
    seed: int = 0,
    out: str | os.PathLike[str] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    data: Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
    **kept: Unpack[FolderOptions],
) -> MemoryRun | FolderRun:
    """Fit a method to a scene in this process, with a progress bar.

    Size, test views and samples per pixel are chosen by `load_scene`, preset and values of the recipe by `load_method`.

    Ctrl-C, or a notebook's stop button, ends the fit after a whole step and returns it as it is. Without ``out``,
    `MemoryRun.resume` goes on; with ``out``, the same call goes on from the folder's checkpoint, and opens what is finished.

    Args:
        method: name, path of a recipe, table, or loaded method.
        scene: loaded, made in Python, or what `load_scene` opens.
        budget: seconds of optimisation (``60s``, ``2m``, ``1h``) or steps (``5000steps``).
        seed: of the initial values and of the fit.
        out: folder that keeps the run as ``invgraphics fit`` does, scores included; ``None`` keeps it in memory.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        data: what is done to the training data: the keys that the command line takes as ``--set data.KEY=value``, such as
            ``{"train_views": 4, "init": "sfm"}`` (`invgraphics.scenes.degrade.TrainingData` explains them).
        on_step: is given the fit before its first step and after each one, on no clock: ``fit.steps``, ``fit.seconds``,
            ``fit.progress``, ``fit.model``, ``fit.plan``.
        **kept: ``snapshots=N``: states of the model that ``out`` keeps for a time-lapse, evenly over the fit; ``keep=True``:
            the fit in ``out`` goes on although code, threads or packages have changed since.

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
    snapshots, keep = kept.pop("snapshots", 0), kept.pop("keep", False)
    if kept:
        raise TypeError(f"fit() got an unexpected keyword argument '{next(iter(kept))}'")
    settings: dict[str, Any] = {"budget": budget, "seed": whole_seeds([seed])[0], "device": device}
    settings |= {"snapshots": snapshots, "keep": keep}
    source = source_of(scene)
    where = scene.name if source is None else source.spec
    request = FitRequest(
        method="", scene=where, out="" if out is None else str(out), overrides=data_overrides(data), **settings
    )
    if out is not None:
        return _fit_in_folder(method, scene, request, on_step)
    name, table = resolved(method, budget)
    return MemoryRun(Job.of(replace(request, method=name), table), scene, on_step)


def _fit_in_folder(method: MethodLike, scene: Scene, request: FitRequest, on_step: OnStep | None) -> FolderRun:
    """Fit into the request's folder, or go on there; the request's method and scene are still to be named."""
    folder = RunFolder(Path(request.out))
    folder.create()
    existing: Literal["resume", "refuse"] = "resume" if folder.identity else "refuse"
    name, table = resolved(method, request.budget, str(folder.root / RECIPE))  # written once the folder is the run's own
    scene, place = reopenable_scene(scene, folder.root)
    try:
        make_run(Job.of(replace(request, method=name, existing=existing, **place), table), scene, on_step)
    except KeyboardInterrupt as error:
        if isinstance(error, Terminated) or not folder.resumable:
            raise
        print(f"Interrupted; the same call continues from {folder.root}.", file=sys.stderr)
    return FolderRun(load_fitted(folder, scene))


def evaluate(model: Model | FittedRun, scene: Scene | str, protocol: str = "default") -> ScoreTable:
    """Render a scene's test views and score them by the rules of the command line.

    Args:
        model: any field and renderer, or a fit.
        scene: loaded, made in Python, or what `load_scene` opens.
        protocol: ``default`` (pictures rounded to 8 bits) or ``float``.

    Raises:
        InputError: the scene or the protocol cannot be used, or the fit has refined poses of other photographs.

    Example:
        >>> import invgraphics as ig
        >>> scene = ig.load_scene("toy.npz", size=16)
        >>> scores = ig.evaluate(ig.fit("splatting/gaussians", scene, budget="20steps").model, scene)
        >>> scores["psnr"] == sum(scores.per_view("psnr")) / len(scene.test), scores.unit("psnr")
        (True, 'dB')
    """
    scene = as_scene(scene)
    if isinstance(model, FittedRun):
        same = scene.digest("train") == model.scene.digest("train")
        if model.poses is not None and not same:
            raise InputError(
                f"{model.method.name} has refined poses of other photographs.", "Give the scene that it was fitted to."
            )
        seen = model.as_trained(scene) if same else None
        return ScoreTable(score_model(model.model, scene, protocol, model.method.name, model.poses, training_scene=seen))
    if not isinstance(model, Model):
        raise InputError(
            f"A {type(model).__name__} cannot be scored.", "Expected: a model, a fit, or what ig.load_run returns."
        )
    title = f"{type(model.field).__name__} through {type(model.renderer).__name__}"
    return ScoreTable(score_model(model, scene, protocol, title))
