"""Which cameras are believable beside the others."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics.core import Scene, View
from invgraphics.core.believable import check_scene
from invgraphics.errors import InputError
from invgraphics.testing import toy_scene


def _scene(places: Tensor, space: str = "contracted") -> Scene:
    """Cameras at ``places`` (n, 3), the first of which is scored."""
    scene = toy_scene(views=3, size=8)

    def at(place: Tensor) -> View:
        pose = scene.train[0].camera.cam_to_world.clone()
        pose[:3, 3] = place
        return replace(scene.train[0], camera=scene.train[0].camera.moved(pose))

    views = tuple(at(place) for place in places)
    bounds = replace(scene.bounds, space=space, near=0.05)
    return replace(scene.with_views(train=views[1:], test=views[:1]), bounds=bounds)


def _jitter(count: int, size: float) -> Tensor:
    return size * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    "places",
    [
        torch.tensor([[0.5, 0.2, 0.0], [-0.5, 0.2, 0.0]]),
        torch.tensor([[0.5, 1e-17, 0.0], [-0.5, 0.0, 1e-18]]),
        torch.tensor([[0.3, 0.9, -0.4], [-0.7, 0.1, 0.6]]),
        torch.tensor([[0.5, 0.0, 0.0]] * 2 + [[-0.5, 0.0, 1e-17]]),
        torch.tensor([0.6, 0.0, 0.8]) + _jitter(12, 1e-3),
        torch.cat([torch.tensor([0.6, 0.0, 0.8]) + _jitter(12, 1e-8), torch.tensor([[-0.5, 0.3, 0.2]])]),
        torch.cat([torch.tensor([0.6, 0.0, 0.8]) + _jitter(12, 1e-3), torch.tensor([[-0.5, 0.3, 0.2]])]),
        _jitter(12, 1e-12) * torch.logspace(0, 5, 12)[:, None],
    ],
    ids=["stereo", "stereo with rounding", "any two", "two of three", "tripod", "rounding", "jitter", "noise of any ratio"],
)
@pytest.mark.parametrize("space", ["contracted", "box"])
def test_cameras_of_real_captures_are_believed(places: Tensor, space: str) -> None:
    check_scene(_scene(places, space))


@pytest.mark.parametrize("spread", [1.0, 1e-3, 0.0])
def test_a_camera_far_from_all_others_is_not(spread: float) -> None:
    """Those would be one point to it: at ten thousand times their own distances, or, in one place, the bounds' radius."""
    places = _jitter(13, spread)
    places[3] = torch.tensor([2e4 * spread or 1e5, 0.0, 0.0])
    scene = _scene(places)
    scene = replace(scene, train=tuple(replace(view, name=str(index)) for index, view in enumerate(scene.train)))
    with pytest.raises(InputError, match=r"The view '2' .* (times as far away as|radii of the bounds away from) most others"):
        check_scene(scene)
