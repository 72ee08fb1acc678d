"""Evaluation of a fitted model: every test view rendered, kept and scored. A method never scores itself."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from invgraphics import locks
from invgraphics.config import fill
from invgraphics.core import Camera, Model, Quantity, Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb, quantise
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.below_baseline import below_baseline, coverage_and_depth
from invgraphics.experiments.clocks import PictureClock, disturbance, fit_costs
from invgraphics.experiments.fitted import Fitted, check_complete, load_fitted, open_fitted
from invgraphics.experiments.identity import truth_digest
from invgraphics.experiments.posed import PosedEvaluation, protocol_note, scene_in_fit_frame
from invgraphics.experiments.progress import Reporter, warn
from invgraphics.experiments.scaled import scaled_scores
from invgraphics.experiments.subjects import UnseenInstances
from invgraphics.experiments.surface_scores import surface_scores
from invgraphics.files import write_arrays, write_picture
from invgraphics.metrics.cost import model_bytes, parameter_count
from invgraphics.metrics.protocols import describe_non_finite_pixels, protocol_named, score, summarise
from invgraphics.recipes.recipe import Method
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.run import truth_arrays, truth_picture
from invgraphics.runs.scores import Scores
from invgraphics.scenes.degrade import KEEP, TrainingData, degrade
from invgraphics.training.limits import DEAD_SHARE, dead_gaussians
from invgraphics.training.poses import Poses

TIMED = 6
"""Test views that are timed where the truth has normals, at most: there the timed picture is one more than the scored one."""


PICTURE_SECONDS = 0.2
"""A picture that took longer is not tried at the next size to forecast the time of an evaluation."""


def expected_seconds(model: Model, scene: Scene) -> float:
    """Estimate the seconds to render all test views, from pictures of the first one that grow while they are cheap.

    A picture's cost has a part that does not grow with its pixels, and the first one's also has compilation.
    """
    camera = scene.test[0].camera
    sizes = [(max(8, camera.width // divisor), max(8, camera.height // divisor)) for divisor in (8, 4, 2, 1)]
    model.render(camera.resized(*sizes[0]))
    pixels, seconds = 1, 0.0
    for width, height in sizes:
        began = time.perf_counter()
        model.render(camera.resized(width, height))
        pixels, seconds = width * height, time.perf_counter() - began
        if seconds > PICTURE_SECONDS:
            break
    return seconds * len(scene.test) * (camera.width * camera.height) / pixels


def evaluate(
    folder: RunFolder,
    scene: Scene,
    model: Model,
    protocol: str,
    costs: dict[str, float | None],
    method: Method,
    poses: Poses | None = None,
) -> Scores:
    """Render and score all test views of ``scene``; writes predictions and scores to the run folder, returns the scores.

    Where the fit has refined its training poses, test poses are aligned and refined first (see `experiments.posed`).
    """
    folder.arrays(0).parent.mkdir(exist_ok=True)
    provenance = folder.read(Provenance)
    found = score_model(
        model,
        scene,
        protocol,
        method.name,
        poses,
        on_picture=lambda index, picture: _save_view(folder, index, picture, scene),
        training_scene=scene_as_trained(scene, provenance.data, provenance.data_seed),
    )
    quality, skipped = scaled_scores(model, scene, protocol, provenance.data, refined=poses is not None)
    result = replace(
        found,
        quality=found.quality | quality,
        skipped=found.skipped | skipped,
        preset=method.preset,
        preset_choice=method.preset_choice,
        seed=provenance.seed,
        cost=costs | found.cost,
        disturbed=disturbance(costs | found.cost),
        test_poses="" if poses is None else protocol_note(method),
        test_exposure=provenance.test_exposure,
    )
    folder.write(result)
    return result


def scene_as_trained(scene: Scene, changes: Mapping[str, object], seed: int) -> Scene:
    """The scene with the photographs of a fit, over its own background; unchanged where this copy cannot give them.

    Args:
        scene: as loaded.
        changes: of the training data, as a run's record holds them.
        seed: of these.
    """
    data = replace(fill(TrainingData, changes), init="random", background=KEEP)  # without points, which take minutes
    if not data.changes_photographs:
        return scene
    try:
        return degrade(scene, data, seed)
    except InputError:
        return scene


def score_model(
    model: Model,
    scene: Scene,
    protocol: str,
    title: str,
    poses: Poses | None = None,
    on_picture: Callable[[int, Rendering], None] = lambda index, picture: None,
    training_scene: Scene | None = None,
) -> Scores:
    """Render and score all test views of ``scene`` without a run folder; returns their quality and the model's cost.

    Of a class of objects, the instances of the test views are unseen: each is inferred from its first observed view.

    Args:
        model: what is scored.
        scene: as loaded.
        protocol: name of the rules.
        title: what the model is called, on the progress bar, in sentences and in the scores.
        poses: of the training views, where the fit has refined them: test poses are then aligned and refined first.
        on_picture: called with the number of each view and its rendering.
        training_scene: the scene as the fit saw it, for the mean training image; ``None`` where that is ``scene``.

    Raises:
        NumericalError: a value of the model is not finite.
    """
    rules = protocol_named(protocol)
    if found := model.describe_non_finite():
        raise NumericalError(f"{title} cannot be scored: {found}.")
    scores, statistics_of_views, clock = [], [], PictureClock()
    posed = None if poses is None else PosedEvaluation(poses, scene, model)
    unseen = UnseenInstances.infer(model, scene) if scene.is_class else None
    with Reporter(f"{title} evaluation") as reporter:
        model.render(scene.test[0].camera.resized(16, 16))  # first use pays for allocation
        for index, view in enumerate(scene.test):
            camera = view.camera if posed is None else posed.camera(view)
            timed = index % ceil(len(scene.test) / TIMED) == 0
            view_model = model if unseen is None else unseen.of(view)
            picture = _picture(view_model, camera, clock, normals=view.normal is not None, timed=timed)
            picture = picture if posed is None else posed.to_scene_frame(picture, camera, view)
            on_picture(index, picture)
            scores.append(score(picture, view, scene, rules))
            if sentence := describe_non_finite_pixels(picture):
                warn(f"Warning: view {view.name}: {sentence}.")
            statistics_of_views.append(coverage_and_depth(picture, view.camera, scene))
            reporter.show((index + 1) / len(scene.test), f"view {index + 1} of {len(scene.test)}")
    quality, skipped = summarise(scores, rules)
    splats = Quantity.GAUSSIANS in model.field.provides
    cost = _picture_costs(clock) | _model_costs(model, scene)
    surface, surface_skipped = surface_scores(model, scene if poses is None else scene_in_fit_frame(poses, scene))
    return Scores(
        method=title,
        scene=scene.name,
        protocol=protocol,
        views=tuple(view.name for view in scene.test),
        cost=cost,
        quality=quality | surface | ({} if posed is None else posed.quality()),
        skipped=skipped | surface_skipped,
        disturbed=disturbance(cost),
        below_baseline=below_baseline(title, quality, statistics_of_views, training_scene or scene, rules, gaussians=splats),
    )


def _picture_costs(clock: PictureClock) -> dict[str, float | None]:
    """Costs of rendering a view, and the share of the processor that they were measured with."""
    seconds = statistics.median(clock.seconds)
    return {
        "render_seconds_per_view": seconds,
        "render_fps": 1 / max(seconds, 1e-9),
        "render_processor_share": clock.processor_share,
    }


def _model_costs(model: Model, scene: Scene) -> dict[str, float | None]:
    """Costs of a fitted model: its size; warns of primitives that can receive no gradient."""
    dead = dead_gaussians(model.field, [view.camera for view in scene.train])
    if dead is not None and dead.share > DEAD_SHARE:
        warn(f"Warning: {dead.sentence()}")
    return {
        "model_bytes": model_bytes(model.parts.values()),
        "parameters": parameter_count(model.parts.values()),
        "primitives": model.field.primitive_count(),
        "dead": None if dead is None else dead.share,
    }


def _picture(model: Model, camera: Camera, clock: PictureClock, *, normals: bool, timed: bool) -> Rendering:
    """Render one view for scoring; ``clock`` also times it as a viewer renders it (colour, alpha, depth)."""
    if normals and not timed:
        return model.render(camera)
    picture = clock.render(model, camera)
    return model.render(camera) if normals else picture


def evaluate_run(run: Path, scene_spec: str | None = None, protocol: str = "default") -> Scores:
    """Score a finished run or rendering again from its checkpoint, on its own scene or on another copy of it.

    Raises:
        InputError: the folder holds no finished run, its checkpoint does not fit, or the scene has other test views.
    """
    fitted = open_fitted(run, scene_spec)
    check_complete(fitted.folder)
    with fitted.folder.held():
        return _evaluate_fitted(fitted, protocol)


def evaluate_saved(folder: RunFolder, scene: Scene, protocol: str) -> Scores:
    """Score the model of a run from its checkpoint; a rendering's is that of the run it shows (see `experiments.renderings`).

    Raises:
        InputError: the checkpoint is missing or does not fit the recipe.
    """
    return _evaluate_fitted(load_fitted(folder, scene), protocol)


def _evaluate_fitted(fitted: Fitted, protocol: str) -> Scores:
    costs = fit_costs(fitted.source.read(FitRecord))
    return evaluate(fitted.folder, fitted.scene, fitted.model, protocol, costs, fitted.method, fitted.poses)


def _save_view(folder: RunFolder, index: int, picture: Rendering, scene: Scene) -> None:
    """Write a prediction: float16 premultiplied with geometry, and an 8-bit picture over the declared background."""
    arrays: dict[str, Any] = {
        "rgb": picture.rgb.numpy().astype(np.float16),
        "alpha": picture.alpha.numpy().astype(np.float16),
        "depth": picture.depth.numpy().astype(np.float32) * np.float32(scene.scale),
    }
    if picture.normal is not None:
        arrays["normal"] = picture.normal.numpy().astype(np.float16)
    write_arrays(folder.arrays(index), arrays)
    write_picture(folder.picture(index), Image.fromarray(display(picture.over(scene.background), scene).numpy()))


def display(colour: torch.Tensor, scene: Scene) -> torch.Tensor:
    """Convert a composited picture to 8-bit display colours."""
    return quantise(linear_to_srgb(colour) if scene.colour == "linear" else colour)


def save_truth(scene: Scene, root: Path) -> Path:
    """Write the test views' truth to ``root/<sha of content>``: pictures, and arrays of what those cannot hold."""
    folder = root / truth_digest(replace(scene, train=(), val=(), observed=(), points=None))[:16]
    folder.mkdir(parents=True, exist_ok=True)
    with locks.locked(folder, folder / locks.INSIDE, waiting=lambda holder: None):  # runs of a study share it
        for index, view in enumerate(scene.test):
            if not truth_picture(folder, index).is_file():
                write_picture(
                    truth_picture(folder, index), Image.fromarray(display(view.over(scene.background), scene).numpy())
                )
            arrays = _truth_arrays(view, scene)
            if arrays and not truth_arrays(folder, index).is_file():
                write_arrays(truth_arrays(folder, index), arrays)
    return folder


def _truth_arrays(view: View, scene: Scene) -> dict[str, Any]:
    """Collect truth that an 8-bit composited picture cannot hold: geometry, mask, straight colour under transparency."""
    arrays: dict[str, Any] = {}
    if view.depth is not None:
        arrays["depth"] = view.depth.numpy() * np.float32(scene.scale)
    if view.normal is not None:
        arrays["normal"] = view.normal.numpy().astype(np.float16)
    if view.alpha is not None:
        arrays["alpha"] = view.opacity().numpy().astype(np.float16)
    if view.alpha is not None or view.image.dtype != torch.uint8:
        image = view.image.numpy()
        arrays["rgb"] = image if image.dtype == np.uint8 else image.astype(np.float16)
    if view.mask is not None:
        arrays["mask"] = view.mask.numpy().astype(bool)
    return arrays
