"""NeuS and VolSDF: each recipe, shrunk, learns shape and colour of a toy scene, and resumes bit by bit."""

import math

import pytest
import torch

from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT

GRID = ["field.encoding.levels=4", "field.encoding.log2_size=12", "field.encoding.finest=48"]
MARCH = ["renderer.sampler.resolution=24", "renderer.sampler.steps_per_diagonal=96", "batches.samples=4096"]
SHRUNK = {
    "hybrid/neus-hash": [*GRID, *MARCH, "renderer.sharpness_final=60"],
    "hybrid/volsdf-hash": [*GRID, *MARCH, "renderer.beta_final=0.02"],
    "hybrid/neus": ["field.width=32", "renderer.sharpness_final=60", "renderer.sampler.coarse=16", "renderer.sampler.fine=8"],
    "hybrid/volsdf": ["field.width=32", "renderer.beta_final=0.02", "renderer.sampler.coarse=16", "renderer.sampler.fine=12"],
}
BATCH = ["batches.rays=128"]


def _scores(fit) -> tuple[float, float]:
    """PSNR, and mean absolute error of depth where prediction and truth have one."""
    scene, errors, depths = fit.plan.scene, [], []
    for view in scene.test:
        picture = fit.plan.model.render(view.camera)
        errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
        both = (picture.alpha >= 0.5) & (view.alpha >= 0.5)
        depths.append((picture.depth - view.depth)[both].abs())
    return -10 * math.log10(float(torch.stack(errors).mean())), float(torch.cat(depths).mean())


@pytest.mark.parametrize("name", SHRUNK)
def test_learns_the_toy_scene(name: str, scene, make_fit) -> None:
    fit = make_fit(name, scene, 120, 0, *SHRUNK[name], *BATCH)
    before, away = _scores(fit)
    fit.run(lambda loss: False)
    after, depth = _scores(fit)
    grid = name.endswith("hash")
    assert after > before + (6 if grid else 2)
    assert depth < (0.09 if grid else 0.15) < away


@pytest.mark.parametrize("name", ["hybrid/neus-hash", "hybrid/volsdf-hash"])
def test_resumed_equals_uninterrupted(name: str, scene, make_fit, tmp_path) -> None:
    whole, first, second = (make_fit(name, scene, 24, 0, *SHRUNK[name], *BATCH) for _ in range(3))
    whole.run(lambda loss: False)
    first.run(lambda loss: first.steps == 13)
    checkpoint.save(tmp_path / CHECKPOINT, first.state())
    torch.manual_seed(99)
    second.load(checkpoint.load(tmp_path / CHECKPOINT), seconds=1.0)
    second.run(lambda loss: False)
    one, other = whole.state(), second.state()
    assert all(torch.equal(one[part][key], other[part][key]) for part in one for key in one[part])
