"""Factors, planes and dense grids: each recipe, shrunk, learns the toy scene from its poses, and resumes bit by bit."""

import math
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from training_fixtures import State, resume, run_whole, same_state

from invgraphics.runs.folder import CHECKPOINT
from invgraphics.training.fit import Fit

SAMPLER = [
    "renderer.sampler.resolution=24",
    "renderer.sampler.steps_per_diagonal=96",
    "renderer.sampler.early_steps=96",
    "renderer.sampler.grace=8",
]
BATCH = ["batches.rays=128", "batches.samples=4096"]
SHRUNK = {
    "volumetric/tensorf-vm": [
        "field.encoding.resolution=16",
        "field.appearance.resolution=16",
        "field.appearance.components=8",
        "hooks.0.resolutions=[24]",
    ],
    "volumetric/tensorf-cp": ["field.encoding.resolution=32", "field.appearance.resolution=32", "field.encoding.components=32"],
    "volumetric/triplane": ["field.encoding.resolution=24", "field.encoding.features=8"],
    "volumetric/dense": ["field.encoding.resolution=33", "field.encoding.coarsest=5", "field.encoding.levels=4"],
}
STEPS = 300


def _psnr(fit) -> float:
    scene, errors = fit.plan.scene, []
    with torch.no_grad():
        for view in scene.test:
            picture = fit.plan.model.render(view.camera, normals=False)
            errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
    return -10 * math.log10(float(torch.stack(errors).mean()))


class Learnt(NamedTuple):
    """A fit at its end."""

    name: str
    fit: Fit
    before: float
    checkpoint: Path
    final: State


@pytest.fixture(scope="module", params=SHRUNK)
def learnt(request: pytest.FixtureRequest, scene, make_fit, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    torch.manual_seed(0)
    fit, path = _fit(request.param, scene, make_fit), tmp_path_factory.mktemp("fits") / CHECKPOINT
    before = _psnr(fit)
    return Learnt(request.param, fit, before, path, run_whole(fit, STEPS, path))


def _fit(name: str, scene, make_fit) -> Fit:
    return make_fit(name, scene, STEPS, 0, *SHRUNK[name], *SAMPLER, *BATCH)


def test_learns_the_toy_scene(learnt: Learnt) -> None:
    assert _psnr(learnt.fit) > max(learnt.before + 8, 20)


def test_resumed_equals_uninterrupted(learnt: Learnt, scene, make_fit) -> None:
    assert same_state(resume(_fit(learnt.name, scene, make_fit), learnt.checkpoint), learnt.final)
