"""Cameras and scenes for the renderers' tests."""

from collections.abc import Callable

import pytest
import torch

from invgraphics.core import Bounds, Camera, Scene, View
from invgraphics.core.transforms import look_at


@pytest.fixture
def make_camera() -> Callable[..., Camera]:
    """A float64 camera that looks at the origin from (0.4, -3, 0.6)."""

    def make(width: int = 12, height: int = 10, focal: float = 14.0) -> Camera:
        eye, up = torch.tensor([0.4, -3.0, 0.6]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
        lens, centre = torch.tensor([focal, focal]).double(), torch.tensor([width / 2 + 0.4, height / 2 - 0.3]).double()
        return Camera(look_at(eye, torch.zeros(3).double(), up), lens, centre, width, height)

    return make


@pytest.fixture
def make_scene(make_camera: Callable[..., Camera]) -> Callable[..., Scene]:
    """A float32 scene of one grey view over the box [-1.5, 1.5]³, or around it."""

    def make(space: str = "box") -> Scene:
        view = View(make_camera().to(torch.float32), torch.full((10, 12, 3), 0.5), "grey")
        bounds = Bounds(torch.full((3,), -1.5), torch.full((3,), 1.5), space)
        return Scene("tiny", (view,), (view,), torch.ones(3), bounds)

    return make
