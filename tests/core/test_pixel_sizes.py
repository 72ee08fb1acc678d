"""Sizes of pixels in space, against distances over focal lengths."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera
from invgraphics.core.camera import pixel_limit, pixel_sizes


def camera(position: tuple[float, float, float], focal: float) -> Camera:
    """A camera that looks along +z."""
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor(position)
    return Camera(pose, torch.tensor([focal, focal]), torch.tensor([50.0, 50.0]), 100, 100)


def test_pixel_sizes_are_distances_over_focal_lengths_of_the_nearest_camera() -> None:
    """A point beside one of two cameras, out of its sight, counts too."""
    cameras = [camera((0.0, -4.0, 0.0), 40.0), camera((0.0, 4.0, 0.0), 40.0)]
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [3.0, 4.0, 0.0]])
    torch.testing.assert_close(pixel_sizes(points, cameras), torch.tensor([4.0, 3.0, 3.0]) / 40)


def test_vertices_are_never_closer_than_the_pixels_of_the_nearest_camera() -> None:
    """A box of 2 x 2 x 4 far from two cameras: a pixel is the distance over the focal length of the nearer one."""
    far = [camera((0.0, 0.0, -400.0), 5000.0), camera((0.0, 0.0, -900.0), 5000.0)]
    bounds = Bounds(torch.tensor([-1.0, -1.0, -2.0]), torch.tensor([1.0, 1.0, 2.0]))
    expected = 16 ** (1 / 3) * 5000.0 / 400.0
    assert pixel_limit(bounds, far) == pytest.approx(expected, rel=0.01)
    assert pixel_limit(replace(bounds, space="contracted"), far) == pytest.approx(2 * expected, rel=0.01)
