"""Factors, planes and dense grids: each recipe, shrunk, learns the toy scene from its poses, and resumes bit by bit."""

import pytest
import torch
from training_fixtures import Learnt, learn, resume, same_state, toy_scores

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


@pytest.fixture(scope="module", params=SHRUNK)
def learnt(request: pytest.FixtureRequest, scene, make_fit, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    torch.manual_seed(0)
    fit = _fit(request.param, scene, make_fit)
    return learn(request.param, fit, STEPS, tmp_path_factory.mktemp("fits"))


def _fit(name: str, scene, make_fit) -> Fit:
    return make_fit(name, scene, STEPS, 0, *SHRUNK[name], *SAMPLER, *BATCH)


def test_learns_the_toy_scene(learnt: Learnt) -> None:
    assert toy_scores(learnt.fit).psnr > max(learnt.before.psnr + 8, 20)


def test_resumed_equals_uninterrupted(learnt: Learnt, scene, make_fit) -> None:
    assert same_state(resume(_fit(learnt.name, scene, make_fit), learnt.checkpoint), learnt.final)
