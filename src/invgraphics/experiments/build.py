"""From a method and a scene to the objects of a fit."""

from __future__ import annotations

from typing import Any

import torch

from invgraphics import kernels
from invgraphics.config import fill
from invgraphics.core import Field, RayRenderer, Renderer, Scene, check
from invgraphics.errors import InputError
from invgraphics.experiments.progress import Reporter
from invgraphics.experiments.request import DATA, Settings
from invgraphics.recipes.recipe import Method, assign, load_method
from invgraphics.recipes.schema import Recipe
from invgraphics.scenes.degrade import TrainingData
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Plan
from invgraphics.training.poses import coarse_to_fine_encodings, make_poses


def requested_method(name: str, request: Settings) -> Method:
    """The method that a request names, under the request's preset (or its budget's) and overrides.

    Raises:
        InputError: as `load_method`, or the budget cannot be read.
    """
    return load_method(name, request.preset, request.recipe_overrides, Budget.parse(request.budget))


def device_of(name: str | None) -> torch.device:
    """The device a run uses: the one that was asked for, else the CPU.

    Raises:
        InputError: no such device here.
    """
    if name in (None, "cpu"):
        return torch.device("cpu")
    if name == "cuda":
        if not torch.cuda.is_available():
            raise InputError("--device cuda: this machine offers torch no CUDA device.", "Use --device cpu.")
        return torch.device("cuda")
    raise InputError(f"--device cannot be '{name}'.", "Expected: cpu or cuda.")


def training_data(settings: Settings) -> TrainingData:
    """What a request does to training data.

    Raises:
        InputError: a key is unknown, or a value of the wrong type or range.
    """
    table: dict[str, Any] = {}
    assign(table, settings.data_overrides)
    return fill(TrainingData, table.get(DATA.rstrip("."), {}), DATA.rstrip("."))


def open_requested(settings: Settings) -> Scene:
    """Open the scene that a request names; how far its rendering is, where it has to be rendered, is shown.

    Raises:
        InputError: the scene cannot be opened.
    """
    options = SceneOptions(size=settings.size, test_views=settings.test_views, spp=settings.spp)
    with Reporter(f"rendering {settings.scene}") as reporter:
        return open_scene(settings.scene, options, lambda done, total, what: reporter.show(done / max(total, 1), what))


def build_model(method: Method, scene: Scene, seed: int, device: torch.device) -> tuple[Field, Renderer]:
    """Field and renderer of a method for a scene, checked against each other; initial values depend on ``seed`` only."""
    torch.manual_seed(seed)
    field: Field = method.recipe.field.build(scene)
    renderer: Renderer = method.recipe.renderer.build(scene)
    check(field, renderer)
    training = method.recipe.training
    if training is not None and training.poses is not None and training.poses.optimise:
        for encoding in coarse_to_fine_encodings(field, renderer):
            encoding.add_window()
    return field.to(device), renderer.to(device)


def build_plan(method: Method, scene: Scene, budget: Budget, seed: int, device: torch.device) -> Plan:
    """Everything a fit is made of."""
    recipe = method.recipe
    field, renderer = build_model(method, scene, seed, device)
    poses = make_poses(recipe.training, scene)
    return Plan(
        field=field,
        renderer=renderer,
        scene=scene,
        losses=recipe.losses,
        hooks=[hook.build() for hook in recipe.hooks],
        optimiser=recipe.optimiser
        if poses is None
        else poses.config.optimiser(recipe.optimiser, _view_share(recipe, renderer, scene)),
        batches=recipe.batches if poses is None else poses.config.batches(recipe.batches),
        budget=budget,
        seed=seed,
        device=device,
        poses=None if poses is None else poses.to(device),
    )


def _view_share(recipe: Recipe, renderer: Renderer, scene: Scene) -> float:
    """Share of the training views in one step's batch."""
    views = len(scene.train)
    return min(recipe.batches.views, views) / views if isinstance(renderer, RayRenderer) else 1 / views


def use_kernels(name: str | None) -> None:
    """Choose kernels by name, and compile what needs compiling before any clock runs."""
    kernels.use(name)
    kernels.warm_up()


def repeatable(device: torch.device) -> None:
    """Ask torch for sums in a fixed order; on a CPU that makes the same seed and threads give the same bits."""
    torch.use_deterministic_algorithms(device.type == "cpu", warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]  # a debugging aid, slow
