"""The browser's camera and ours are one camera: points land where the textbook's formula puts them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from invgraphics.core import Camera
from invgraphics.core.transforms import look_at, rigid
from invgraphics.testing import toy_cameras, toy_scene
from invgraphics.viewer.cameras import (
    LetterboxedView,
    ViewerCamera,
    fov_and_aspect,
    limit_size,
    nearest_view_index,
    rotation_quaternion,
    subregion,
)
from invgraphics.viewer.server import upward

POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(3)) - 0.5


def _lopsided(width: int = 90, height: int = 60, stretch: float = 1.0) -> Camera:
    pose = look_at(torch.tensor([2.0, -1.0, 0.7]), torch.zeros(3), torch.tensor([0.1, 0.3, 1.0]))
    return Camera(
        pose, torch.tensor([100.0 * stretch, 100.0]), torch.tensor([width / 2 + 7.0, height / 2 - 4.0]), width, height
    )


def _seen_by_browser(wxyz, position, fov: float, points: np.ndarray) -> np.ndarray:
    """Window coordinates, -1 to 1 from bottom to top and likewise sideways, by Hamilton's formula and OpenGL's projection."""
    w, x, y, z = wxyz
    axis = np.array([x, y, z])
    moved = points - np.asarray(position)
    # Turned by the inverse rotation: v + 2 w (v x a) + 2 (v x a) x a.
    turned = np.cross(moved, axis)
    inside = moved + 2 * w * turned + 2 * np.cross(turned, axis)
    up, forward = -inside[:, 1], inside[:, 2]
    return np.stack([inside[:, 0], up], axis=1) / forward[:, None] / math.tan(fov / 2)


@pytest.mark.parametrize("aspect", [0.6, 1.0, 2.3])
def test_what_a_browser_reports_is_our_camera(aspect: float) -> None:
    pose = _lopsided().cam_to_world
    viewer_camera = ViewerCamera.from_viser(rotation_quaternion(pose), tuple(pose[:3, 3].tolist()), 0.9, aspect)
    torch.testing.assert_close(viewer_camera.pose, pose, atol=1e-6, rtol=0)
    width, height = 317, 200
    pixels, depth = viewer_camera.pinhole(width, height).project(POINTS)
    assert bool((depth > 0).all())
    expected = _seen_by_browser(rotation_quaternion(pose), pose[:3, 3].numpy(), 0.9, POINTS.numpy())
    ours = np.stack([(pixels[:, 0] / width * 2 - 1) * aspect, 1 - pixels[:, 1] / height * 2], axis=1)
    np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.parametrize("aspect", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("stretch", [1.0, 1.2])
def test_a_mounted_photograph_fills_its_window_and_fits_the_browser(aspect: float, stretch: float) -> None:
    camera = _lopsided(stretch=stretch)
    letterbox = LetterboxedView.fit(camera, aspect)
    assert letterbox.width / letterbox.height == pytest.approx(aspect, rel=0.03)
    assert (
        0 <= letterbox.left <= letterbox.width - letterbox.camera.width
        and 0 <= letterbox.top <= letterbox.height - letterbox.camera.height
    )
    slack = min(letterbox.width - letterbox.camera.width, letterbox.height - letterbox.camera.height)
    assert slack <= 16, "as large as it fits: only the principal point's offset leaves space"
    pixels, _ = camera.project(POINTS)
    in_window = pixels * torch.tensor([letterbox.camera.width / camera.width, 1.0]) + torch.tensor(
        [letterbox.left, letterbox.top]
    )
    browser = ViewerCamera(camera.cam_to_world, letterbox.fov, letterbox.width / letterbox.height).pinhole(
        letterbox.width, letterbox.height
    )
    assert float((browser.project(POINTS)[0] - in_window).abs().max()) < 1.0


def test_a_part_has_the_rays_of_the_whole() -> None:
    camera = _lopsided()
    whole = camera.rays().directions.view(60, 90, 3)
    cut = subregion(camera, (11, 50), (5, 32))
    torch.testing.assert_close(cut.rays().directions.view(27, 39, 3), whole[5:32, 11:50])


def test_a_frustum_has_the_angles_between_its_corners() -> None:
    camera = toy_cameras(1, 40)[0].resized(60, 40)
    fov, aspect = fov_and_aspect(camera)
    corners = camera.rays(torch.tensor([[30.0, 0.0], [30.0, 40.0], [0.0, 20.0], [60.0, 20.0]])).directions
    assert fov == pytest.approx(float((corners[0] @ corners[1]).acos()), abs=1e-5)
    across = float((corners[2] @ corners[3]).acos())
    assert math.tan(across / 2) / math.tan(fov / 2) == pytest.approx(aspect, rel=1e-5)


def test_limits() -> None:
    camera = _lopsided()
    assert (limit_size(camera, 45).width, limit_size(camera, 45).height) == (45, 30)
    assert limit_size(camera, 200) is camera


def test_standing_at_a_photograph_is_noticed_and_leaving_too() -> None:
    pose = _lopsided().cam_to_world
    here = ViewerCamera(pose, 1.0, 1.0)
    assert here.is_at(pose, 1e-3, 1e-3)
    aside = pose.clone()
    aside[0, 3] += 2e-3
    assert not here.is_at(aside, 1e-3, 1.0) and here.is_at(aside, 3e-3, 1e-3)
    angle = 3e-3
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    turned = rigid(pose[:3, :3] @ turn, pose[:3, 3])
    assert not here.is_at(turned, 1.0, 1e-3) and here.is_at(turned, 1e-3, 4e-3)


def test_the_nearest_photograph() -> None:
    scene = toy_scene(views=8, size=8)
    for index, view in enumerate(scene.train):
        pose = view.camera.cam_to_world.clone()
        pose[:3, 3] *= 1.1
        assert nearest_view_index(scene.train, ViewerCamera(pose, 1.0, 1.0), scene.extent) == index


def test_up_is_the_frames_unless_the_photographs_disagree() -> None:
    scene = toy_scene(views=8, size=8)
    assert upward(scene) == (0.0, 0.0, 1.0)
    over = torch.tensor([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0], [0, 0, 0, 1.0]])
    turned = tuple(replace(v, camera=v.camera.moved(over @ v.camera.cam_to_world)) for v in scene.train)
    assert upward(scene.with_views(train=turned))[2] < -0.7
