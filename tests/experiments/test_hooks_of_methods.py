"""Every method with hooks fits through all their milestones, in a box and in contracted space."""

import pytest
import torch

from invgraphics.experiments.build import build_plan
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit

STEPS = 20
CHANGES = {
    "volumetric/dvgo": ["hooks.0.threshold=1e-6"],  # not everything is empty after four steps
    "volumetric/plenoxels": ["hooks.0.rays=256"],
    "volumetric/point-nerf": ["hooks.0.rays=64"],
}
WITH_HOOKS = [name for name in methods() if load_method(name, "laptop").recipe.hooks]


@pytest.mark.parametrize("name", WITH_HOOKS)
@pytest.mark.parametrize("space", ["box", "contracted"])
def test_all_hooks_act(name: str, space: str) -> None:
    method = load_method(name, "laptop", ["batches.rays=32", *CHANGES.get(name, [])])
    scene = toy_scene(views=3, size=12, space=space)
    fit = Fit(build_plan(method, scene, Budget(steps=STEPS), 0, torch.device("cpu")))
    losses: list[float] = []
    fit.run(lambda loss: bool(losses.append(float(loss))))
    assert len(losses) == STEPS
    assert torch.tensor(losses).isfinite().all()
