"""NeuS and VolSDF: each recipe, shrunk, learns shape and colour of a toy scene, and resumes bit by bit."""

import math
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from training_fixtures import State, resume, run_whole, same_state

from invgraphics.runs.folder import CHECKPOINT
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


def _scores(fit) -> tuple[float, float]:
    """PSNR, and mean absolute error of depth where prediction and truth have one."""
    scene, errors, depths = fit.plan.scene, [], []
    for view in scene.test:
        picture = fit.plan.model.render(view.camera)
        errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
        both = (picture.alpha >= 0.5) & (view.alpha >= 0.5)
        depths.append((picture.depth - view.depth)[both].abs())
    return -10 * math.log10(float(torch.stack(errors).mean())), float(torch.cat(depths).mean())


class Learnt(NamedTuple):
    """A fit at its end."""

    name: str
    fit: Fit
    before: tuple[float, float]
    checkpoint: Path
    final: State


@pytest.fixture(scope="module", params=SHRUNK)
def learnt(request: pytest.FixtureRequest, scene, make_fit, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    torch.manual_seed(0)
    fit, path = _fit(request.param, scene, make_fit), tmp_path_factory.mktemp("fits") / CHECKPOINT
    before = _scores(fit)
    return Learnt(request.param, fit, before, path, run_whole(fit, STEPS, path))


def _fit(name: str, scene, make_fit) -> Fit:
    return make_fit(name, scene, STEPS, 0, *SHRUNK[name], *BATCH)


def test_learns_the_toy_scene(learnt: Learnt) -> None:
    (before, away), (after, depth) = learnt.before, _scores(learnt.fit)
    grid = learnt.name.endswith("hash")
    assert after > before + (6 if grid else 2)
    assert depth < (0.09 if grid else 0.15) < away


@pytest.mark.parametrize("learnt", ["hybrid/neus-hash", "hybrid/volsdf-hash"], indirect=True)
def test_resumed_equals_uninterrupted(learnt: Learnt, scene, make_fit) -> None:
    assert same_state(resume(_fit(learnt.name, scene, make_fit), learnt.checkpoint), learnt.final)
