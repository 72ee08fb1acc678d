"""The extent of a scene, in which 3DGS states its rates and thresholds."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Scene, View
from invgraphics.testing import toy_scene


def _at(view: View, x: float) -> View:
    pose = view.camera.cam_to_world.clone()
    pose[:3, 3] = torch.tensor([x, 0.0, 3.0])
    return replace(view, camera=view.camera.moved(pose))


def _scene(*places: float) -> Scene:
    scene = toy_scene(views=3, size=8)
    return scene.with_views(train=tuple(_at(scene.train[0], x) for x in places))


def test_extent_is_that_of_3dgs() -> None:
    assert _scene(-0.5, 0.1, 1.0).extent == pytest.approx(1.1 * 0.8)


@pytest.mark.parametrize("places", [(0.7,), (0.7, 0.7), (0.7, 0.701, 0.699)], ids=["one view", "a panorama", "a tripod"])
def test_extent_of_cameras_in_one_place_is_that_of_the_bounds(places: tuple[float, ...]) -> None:
    scene = _scene(*places)
    assert scene.extent == pytest.approx(1.1 * scene.bounds.radius)
