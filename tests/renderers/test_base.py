"""Normals of pixels: on the side of the camera, without half turns for small errors."""

import math

import pytest
import torch

from invgraphics.renderers.base import to_rendering


def at_angle(degrees: float) -> torch.Tensor:
    """A normal by its angle from the direction towards the camera, which looks along +z."""
    return torch.tensor([math.sin(math.radians(degrees)), 0.0, -math.cos(math.radians(degrees))])


@pytest.mark.parametrize(
    ("angle", "shown"), [(0.0, 0.0), (80.0, 80.0), (90.5, 90.0), (105.0, 90.0), (150.0, -30.0), (180.0, 0.0)]
)
def test_normals_face_the_camera(angle: float, shown: float) -> None:
    """A surface seen from behind is turned; what points away a little, as along a silhouette, lies across the ray."""
    one = torch.ones(1)
    direction = torch.tensor([[0.0, 0.0, 1.0]])
    picture = to_rendering(torch.zeros(1, 3), 0.8 * one, one, 0.8 * at_angle(angle)[None], torch.inf * one, direction)
    assert picture.normal is not None
    torch.testing.assert_close(picture.normal[0], at_angle(shown), atol=1e-6, rtol=0)
