"""Small objects off the middle: a distance starts as a ball that misses them, and must not end as empty space."""

from dataclasses import replace

import pytest
import torch
from test_hybrid_methods import BATCH, SHRUNK
from training_fixtures import toy_scores

from invgraphics.core import Bounds, Scene
from invgraphics.testing import toy_scene

STEPS = 120


@pytest.fixture(scope="module")
def small_object() -> Scene:
    """The toy scene in a corner of a box three times as large, a fifth as long in the pictures."""
    scene = toy_scene(views=12, size=32, zoom=0.6)
    return replace(scene, bounds=Bounds(torch.full((3,), -1.5), torch.full((3,), 2.5)))


@pytest.mark.parametrize("name", SHRUNK)
def test_is_not_lost(name: str, small_object: Scene, make_fit) -> None:
    torch.manual_seed(0)
    fit = make_fit(name, small_object, STEPS, 0, *SHRUNK[name], *BATCH)
    before = toy_scores(fit)
    fit.run(lambda _loss: False)
    after = toy_scores(fit)
    print(name, before, after)
    assert after.overlap > 0.5
