"""Loading of a finished run: its scene and its fitted model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from invgraphics import plugins
from invgraphics.config import fill
from invgraphics.core import Model, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, device_of
from invgraphics.experiments.identity import check_truth, kept_scene
from invgraphics.experiments.job import in_region
from invgraphics.experiments.posed import refined_poses, scene_in_fit_frame
from invgraphics.kernels.allocator import keep_freed_memory
from invgraphics.kernels.openmp import limit_spinning
from invgraphics.recipes.recipe import Method, resolve
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.history import read_history
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.degrade import KEEP, TrainingData, degrade
from invgraphics.scenes.open import SceneOptions, is_found, open_scene
from invgraphics.training.poses import Poses


@dataclass(frozen=True, eq=False)
class Fitted:
    """A loaded run: recipe, scene, fitted model and refined poses.

    Attributes:
        folder: of the run.
        method: its recipe.
        scene: at the run's size and with its test views, in the box in which it was fitted.
        model: fitted, on the run's device.
        source: the folder that holds the checkpoint: the run itself, or the run that a rendering shows.
        poses: of the training views as the fit saw them, where it refined them.
    """

    folder: RunFolder
    method: Method
    scene: Scene
    model: Model
    source: RunFolder
    poses: Poses | None = None

    def load(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Load a checkpoint's tensors into a model; for a rendering, whose renderer was not fitted, only the field's.

        Raises:
            RuntimeError: they do not fit the model.
        """
        if self.source is self.folder:
            self.model.load_state_dict(state)
        else:
            self.model.field.load_state_dict(state.get("field", {}))

    def at_checkpoint(self, state: Mapping[str, Mapping[str, Any]]) -> Fitted:
        """The run at another checkpoint: the same model, which takes over its tensors, and the poses of then.

        Raises:
            RuntimeError: they do not fit the model.
        """
        config = refined_poses(self.method)
        known = Poses.restored(config, state["poses"]) if config is not None and "poses" in state else None
        self.load(state)
        return replace(self, poses=None if known is None else known.to(self.model.device))

    def in_its_frame(self) -> Fitted:
        """The same run with its scene transformed to the fit's frame, which drifts where poses are refined."""
        return self if self.poses is None else replace(self, scene=scene_in_fit_frame(self.poses, self.scene))


def open_fitted(run: Path, scene_spec: str | None = None) -> Fitted:
    """Open a run, on its own scene or on another copy of it.

    Raises:
        InputError: the folder holds no run, its scene cannot be opened or has other test views today, or its checkpoint does
            not fit its recipe.
    """
    torch.set_flush_denormal(True)  # as in fits (`build.configure_torch`), before the scene is opened and threads start
    folder = RunFolder(run)
    provenance = folder.read(Provenance)
    chosen = provenance.options
    options = SceneOptions(chosen.size, chosen.test_views, spp=None if scene_spec else chosen.spp)
    own = provenance.scene if (kept := kept_scene(folder, provenance.scene)) is None else str(kept)
    if scene_spec is None and not is_found(own):
        sentence = f"The scene of {run}, '{provenance.scene}', is not found from here."
        raise InputError(sentence, "Give its path with --scene, or work where the run was fitted.")
    scene = open_scene(scene_spec or own, options)
    check_truth(folder, scene, scene_spec)
    return load_fitted(folder, scene)


def load_fitted(folder: RunFolder, scene: Scene) -> Fitted:
    """Load a run's model from its checkpoint; a rendering uses the one of the run it shows (see `experiments.renderings`).

    Raises:
        InputError: the checkpoint is missing or does not fit the recipe.
    """
    keep_freed_memory()
    limit_spinning()
    provenance = folder.read(Provenance)
    method = replace(_method(folder, provenance), preset_choice=provenance.preset_choice)
    device = device_of("cuda" if provenance.device.startswith("cuda") and torch.cuda.is_available() else "cpu")
    source = folder.fit(provenance)
    region = source.read(Provenance).region
    trained = in_region(_with_fitted_cameras(scene, provenance), region)
    model = build_model(method, trained, provenance.seed, device, shown=provenance.fitted_run is not None)
    if provenance.fitted_run is not None:
        model = replace(model, renderer=model.renderer.untrained())
    state = checkpoint.load(source.checkpoint, device)
    try:
        return Fitted(folder, method, in_region(scene, region), model, source).at_checkpoint(state)
    except RuntimeError as error:
        raise InputError(f"{source.checkpoint} does not fit the run's recipe.", str(error).splitlines()[-1].strip()) from error


def _with_fitted_cameras(scene: Scene, provenance: Provenance) -> Scene:
    """The scene with the training cameras that a fit had, of which the sizes of some fields are made."""
    data = fill(TrainingData, provenance.data)
    kept = replace(data, init="random", background=KEEP, photo_noise=0.0, exposure=0.0)  # what changes no camera
    if not kept.changes_photographs and not kept.pose_noise and kept.scales == (1,):
        return scene
    try:
        return replace(degrade(scene, kept, provenance.data_seed), points=scene.points)
    except InputError:  # another copy of the scene has fewer photographs, or smaller ones
        return scene


def _method(folder: RunFolder, provenance: Provenance) -> Method:
    """Read the run's recipe.

    Raises:
        InputError: it cannot be resolved here; where packages are missing that the run was made with, the sentence names them.
    """
    try:
        return resolve(provenance.method, provenance.preset, folder.read_recipe())
    except InputError as error:
        used = provenance.plugins
        missing = sorted({package for package in used.values() if not plugins.installed(package)})
        if not missing:
            raise
        names = ", ".join(f"'{name}'" for name, package in used.items() if package in missing)
        sentence = f"{folder.root} was made with {', '.join(missing)}, which provides {names} and is not installed here."
        modules = ",".join(package.removeprefix("module ") for package in missing if package.startswith("module "))
        remedy = "Install the package here."
        if modules:
            remedy = f"Set INVGRAPHICS_MODULES={modules}, and run `python -m invgraphics` in the folder that holds it."
        elif plugins.ANONYMOUS in missing:
            remedy = "Register the parts again by ig.register."
        raise InputError(sentence, remedy) from error


def check_complete(folder: RunFolder) -> None:
    """Refuse an interrupted fit: scores would mark it as finished, so that it never went on.

    Raises:
        InputError: a part of its budget is not spent.
    """
    moments = read_history(folder.history) if folder.history.is_file() and not folder.finished else ()
    progress = moments[-1].progress if moments else None
    if progress is not None and progress < 1:
        what = f"{folder.root} is not finished: {progress:.0%} of its budget are recorded."
        raise InputError(what, "Give its command again with --resume; `invgraphics view` and `render` show it as it is.")
