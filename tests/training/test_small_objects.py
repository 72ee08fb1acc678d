"""Small objects off the middle: most rays see none of them, a distance starts as a ball that misses them; none may be lost.

Without masks and first rays on the object all of these fits end as empty space, at an overlap of 0.00.
"""

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
    """The toy scene off the middle of a box twice as large."""
    scene = toy_scene(views=12, size=32, zoom=0.6)
    return replace(scene, bounds=Bounds(torch.full((3,), -1.5), torch.full((3,), 2.5)))


CONES = {"volumetric/mip-nerf-360": ["field.width=32", "renderer.sampler.counts=[16]"]}


@pytest.mark.parametrize("name", [*SHRUNK, *CONES])
def test_is_not_lost(name: str, small_object: Scene, make_fit) -> None:
    torch.manual_seed(0)
    fit = make_fit(name, small_object, STEPS, 0, *(SHRUNK | CONES)[name], *BATCH)
    fit.run(lambda _loss: False)
    # A network of densities is still a fog after so few steps.
    assert toy_scores(fit).overlap > (0.15 if name in CONES else 0.5)
