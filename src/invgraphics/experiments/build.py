"""Build a fit's model, optimiser plan and kernels from a method and a scene."""

from __future__ import annotations

import functools
from typing import Any, TypeVar

import torch
from torch import nn

from invgraphics import kernels
from invgraphics.core import Field, Model, Quantity, RayRenderer, Renderer, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.memory_check import check_memory
from invgraphics.experiments.progress import Reporter
from invgraphics.experiments.subjects import check_subjects
from invgraphics.experiments.variants import as_shown
from invgraphics.recipes.recipe import Method
from invgraphics.recipes.schema import Recipe
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Plan
from invgraphics.training.poses import TrainingConfig, coarse_to_fine_encodings, make_poses
from invgraphics.training.views.exposure import make_exposures
from invgraphics.training.views.sparse_depth import make_sparse_depth


def device_of(name: str | torch.device | None) -> torch.device:
    """Resolve the torch device of a run: the requested one, else the CPU.

    Raises:
        InputError: no such device here.
    """
    name = "cpu" if name is None else str(name)
    if name == "cpu":
        return torch.device("cpu")
    if name == "cuda":
        if not torch.cuda.is_available():
            raise InputError("PyTorch finds no CUDA device.", "Install a CUDA build of torch, or leave out --device.")
        return torch.device("cuda")
    raise InputError(f"The device cannot be '{name}'.", "Expected: cpu or cuda.")


def open_with_progress(spec: str, options: SceneOptions) -> Scene:
    """Open a scene, with a progress bar where it has to be rendered first.

    Raises:
        InputError: the scene cannot be opened.
    """
    with Reporter(f"rendering {spec}") as reporter:
        return open_scene(spec, options, lambda done, total, what: reporter.show(done / max(total, 1), what))


def build_model(method: Method, scene: Scene, seed: int, device: torch.device, *, shown: bool = False) -> Model:
    """Build a method's field and renderer for a scene; initial values depend on ``seed`` only.

    Args:
        method: what is built.
        scene: as loaded.
        seed: of the initial values.
        device: where.
        shown: whether the renderer only shows a field that another one has fitted (see `variants.as_shown`).
    """
    check_memory(method, scene)
    torch.manual_seed(seed)
    field = _built(method.recipe.field, scene, Field, "provides")
    renderer = _built(method.recipe.renderer, scene, Renderer, "requires")
    check_subjects(field, renderer, scene, method.name)
    if not shown:
        renderer.prepare(field)
    model = Model(as_shown(field, renderer) if shown else field, renderer, scene.bounds)
    training = method.recipe.training
    if training is not None and training.poses is not None and training.poses.optimise:
        for encoding in coarse_to_fine_encodings(model):
            encoding.add_window()
    return model.to(device)


P = TypeVar("P", bound=nn.Module)


def _built(config: Any, scene: Scene, kind: type[P], declares: str) -> P:
    """Build a part from its config, which a third party may have written.

    Args:
        config: of the recipe.
        scene: it is built for.
        kind: class that it must have.
        declares: its attribute that holds quantities.

    Raises:
        InputError: the config builds no such part, or one that declares nothing.
    """
    where = "See docs/extending.md."
    part = config.build(scene)
    if not isinstance(part, kind):
        raise InputError(f"{part!r}, which {type(config).__name__} builds, is no {kind.__name__}.", where)
    if not isinstance(getattr(part, declares, None), Quantity):
        raise InputError(f"{type(part).__name__} declares no quantities as '{declares}'.", where)
    return part


def build_plan(method: Method, scene: Scene, budget: Budget, seed: int, device: torch.device) -> Plan:
    """Build the plan of a fit: model, scene, losses, hooks, optimiser and batch settings, budget, poses and exposures."""
    recipe = method.recipe
    model = build_model(method, scene, seed, device)
    poses = make_poses(recipe.training, scene)
    training = TrainingConfig() if recipe.training is None else recipe.training
    exposures = make_exposures(training.exposure, scene)
    depth = make_sparse_depth(training.sparse_depth, scene, model.renderer, fixed_poses=poses is None)
    optimiser = recipe.optimiser
    if poses is not None:
        optimiser = poses.config.optimiser(optimiser, _view_share(recipe, model.renderer, scene))
    if exposures is not None:
        optimiser = exposures.config.optimiser(optimiser)
    return Plan(
        model=model,
        scene=scene,
        losses=recipe.losses,
        penalties=recipe.penalties if depth is None else (*recipe.penalties, depth.to(device)),
        hooks=[hook.build() for hook in recipe.hooks],
        optimiser=optimiser,
        batches=recipe.batches if poses is None else poses.config.batches(recipe.batches),
        budget=budget,
        seed=seed,
        device=device,
        poses=None if poses is None else poses.to(device),
        exposures=None if exposures is None else exposures.to(device),
    )


def _view_share(recipe: Recipe, renderer: Renderer, scene: Scene) -> float:
    """Share of the training views in one step's batch."""
    views = len(scene.train)
    return min(recipe.batches.views, views) / views if isinstance(renderer, RayRenderer) else 1 / views


def use_kernels(name: str | None, device: torch.device) -> None:
    """Select the kernel backend by name, and compile its kernels for a device before any timing starts."""
    kernels.use(name)
    _warm_up(device, kernels.in_use(device))


@functools.cache
def _warm_up(device: torch.device, backend: str) -> None:
    """Warm a backend's kernels up, once in a process."""
    kernels.warm_up(device)


def configure_torch(device: torch.device) -> None:
    """Set this process's modes for a fit: deterministic algorithms on a CPU, and denormal numbers flushed to zero.

    Deterministic algorithms give the same bits for the same seed and thread count; by the debug mode, as
    ``torch.use_deterministic_algorithms`` imports torch's compiler, two seconds of every process that fits.

    Arithmetic with denormals (below 1e-38) takes a CPU up to a hundred times as long; weights of NeuS vanish into them.
    Threads of torch's and Numba's pools follow if they start later: all of them, unless torch has computed here before.
    """
    torch.set_deterministic_debug_mode("warn" if device.type == "cpu" else "default")
    torch.backends.cudnn.allow_tf32 = False  # of SSIM's variances, differences of two convolutions, 10 bits leave nothing
    torch.utils.deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]  # a debugging aid, slow
    torch.set_flush_denormal(True)
