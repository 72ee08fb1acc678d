"""Factors, planes and dense grids: each recipe, shrunk, learns the toy scene from its poses, and resumes bit by bit."""

import math

import pytest
import torch

from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT

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


def _psnr(fit) -> float:
    scene, errors = fit.plan.scene, []
    with torch.no_grad():
        for view in scene.test:
            picture = fit.plan.model.render(view.camera, normals=False)
            errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
    return -10 * math.log10(float(torch.stack(errors).mean()))


@pytest.mark.parametrize("name", SHRUNK)
def test_learns_the_toy_scene(name: str, scene, make_fit) -> None:
    fit = make_fit(name, scene, 300, 0, *SHRUNK[name], *SAMPLER, *BATCH)
    before = _psnr(fit)
    fit.run(lambda loss: False)
    after = _psnr(fit)
    assert after > max(before + 8, 20)


@pytest.mark.parametrize("name", SHRUNK)
def test_resumed_equals_uninterrupted(name: str, scene, make_fit, tmp_path) -> None:
    whole, first, second = (make_fit(name, scene, 24, 0, *SHRUNK[name], *SAMPLER, *BATCH) for _ in range(3))
    whole.run(lambda loss: False)
    first.run(lambda loss: first.steps == 13)
    checkpoint.save(tmp_path / CHECKPOINT, first.state())
    torch.manual_seed(99)
    second.load(checkpoint.load(tmp_path / CHECKPOINT), seconds=1.0)
    second.run(lambda loss: False)
    one, other = whole.state(), second.state()
    assert all(torch.equal(one[part][key], other[part][key]) for part in one for key in one[part])
