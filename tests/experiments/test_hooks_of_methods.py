"""Every method with hooks fits through all their milestones, in a box and in contracted space, interrupted or not."""

from pathlib import Path

import pytest
import torch
from training_fixtures import resume, run_whole, same_state

from invgraphics.experiments.build import build_plan
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.density_control import DensityControl
from invgraphics.training.fit import Fit

STEPS, LEFT = 20, 9
OCCUPANCY = ["renderer.sampler.resolution=24", "renderer.sampler.steps_per_diagonal=96"]
GRID = ["field.encoding.resolution=16", "field.appearance.resolution=16", *OCCUPANCY]
CHANGES = {
    # Not everything is empty after four steps.
    "volumetric/dvgo": [*GRID, "hooks.0.threshold=1e-6", "hooks.0.resolution=16", "hooks.1.resolution=24"],
    "volumetric/plenoxels": [*GRID, "hooks.0.rays=256", "hooks.1.resolution=24"],
    "volumetric/tensorf-vm": [*GRID, "hooks.0.resolutions=[24]"],
    "volumetric/tensorf-cp": [*GRID, "field.encoding.components=32"],
    "volumetric/triplane": ["field.encoding.resolution=16", "hooks.0.resolution=24", *OCCUPANCY],
    "volumetric/point-nerf": ["hooks.0.rays=64"],
}
WITH_HOOKS = [name for name in methods() if load_method(name, "laptop").recipe.hooks]


def _fit(name: str, space: str) -> Fit:
    """A fit of few steps, of which every fourth is one at which recurring hooks act."""
    hooks = load_method(name, "laptop").recipe.hooks
    often = [f"hooks.{index}.every=4" for index, hook in enumerate(hooks) if hasattr(hook, "every")]
    method = load_method(name, "laptop", ["batches.rays=32", *often, *CHANGES.get(name, [])])
    scene = toy_scene(views=3, size=12, space=space)
    return Fit(build_plan(method, scene, Budget(steps=STEPS), 0, torch.device("cpu")))


@pytest.mark.parametrize("name", WITH_HOOKS)
def test_all_hooks_act(name: str) -> None:
    fit = _fit(name, "contracted")
    losses: list[float] = []
    fit.run(lambda loss: bool(losses.append(float(loss))))
    assert len(losses) == STEPS
    assert torch.tensor(losses).isfinite().all()
    rounds = [hook.last_round for hook in fit.plan.hooks if isinstance(hook, DensityControl)]
    assert all(one is not None and one.step >= STEPS // 3 for one in rounds)


@pytest.mark.parametrize("name", WITH_HOOKS)
def test_resumed_fits_have_the_same_bits_whatever_hooks_did(name: str, tmp_path: Path) -> None:
    """Interrupted between two rounds, so that what hooks have gathered since the last one is needed."""
    whole = run_whole(_fit(name, "box"), STEPS, tmp_path / "checkpoint", LEFT)
    assert same_state(whole, resume(_fit(name, "box"), tmp_path / "checkpoint"))
