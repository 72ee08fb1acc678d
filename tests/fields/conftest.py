"""Small scenes for the fields' tests."""

from collections.abc import Callable

import pytest
import torch

from invgraphics.core import Bounds, Camera, Points, Scene, View


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """A scene of one grey view; its region, colour space and points are free."""

    def make(space: str = "box", colour: str = "srgb", points: Points | None = None, half: float = 1.5) -> Scene:
        camera = Camera(torch.eye(4), torch.tensor([4.0, 4.0]), torch.tensor([2.0, 2.0]), 4, 4)
        view = View(camera, torch.full((4, 4, 3), 0.5), "grey")
        centre = torch.tensor([0.2, -0.1, 0.3])
        bounds = Bounds(centre - half, centre + half, space)
        return Scene("tiny", (view,), (view,), torch.ones(3), bounds, points=points, colour=colour)

    return make
