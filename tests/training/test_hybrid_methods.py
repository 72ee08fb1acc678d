"""NeuS and VolSDF: each recipe, shrunk, learns shape and colour of a toy scene, and resumes bit by bit."""

import math

import pytest
import torch
from training_fixtures import Learnt, learn, resume, same_state, toy_scores

from invgraphics.training.fit import Fit

GRID = ["field.encoding.levels=4", "field.encoding.log2_size=12", "field.encoding.finest=48"]
MARCH = ["renderer.sampler.resolution=24", "renderer.sampler.steps_per_diagonal=96", "batches.samples=4096"]
SHRUNK = {
    "hybrid/neus-hash": [*GRID, *MARCH, "renderer.sharpness_final=60"],
    "hybrid/volsdf-hash": [*GRID, *MARCH, "renderer.beta_final=0.02"],
    "hybrid/neus": ["field.width=32", "renderer.sharpness_final=60", "renderer.sampler.coarse=16", "renderer.sampler.fine=8"],
    "hybrid/volsdf": ["field.width=32", "renderer.beta_final=0.02", "renderer.sampler.coarse=16", "renderer.sampler.fine=12"],
}
BATCH = ["batches.rays=128"]
STEPS = 120


@pytest.fixture(scope="module", params=SHRUNK)
def learnt(request: pytest.FixtureRequest, scene, make_fit, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    torch.manual_seed(0)
    fit = _fit(request.param, scene, make_fit)
    return learn(request.param, fit, STEPS, tmp_path_factory.mktemp("fits"))


def _fit(name: str, scene, make_fit) -> Fit:
    return make_fit(name, scene, STEPS, 0, *SHRUNK[name], *BATCH)


def test_learns_the_toy_scene(learnt: Learnt) -> None:
    before, after = learnt.before, toy_scores(learnt.fit)
    grid = learnt.name.endswith("hash")
    assert after.psnr > before.psnr + (6 if grid else 2)
    assert after.depth < (0.09 if grid else 0.15) < before.depth < math.inf


@pytest.mark.parametrize("learnt", ["hybrid/neus-hash", "hybrid/volsdf-hash"], indirect=True)
def test_resumed_equals_uninterrupted(learnt: Learnt, scene, make_fit) -> None:
    assert same_state(resume(_fit(learnt.name, scene, make_fit), learnt.checkpoint), learnt.final)
