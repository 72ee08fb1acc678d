"""A browser on its way to a photograph: which reported cameras count as leaving it, and how it is sent there."""

from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from invgraphics.testing import toy_scene
from invgraphics.viewer.camera_move import ARRIVAL, CameraMove, send_camera
from invgraphics.viewer.cameras import ViewerCamera


def _camera(x: float) -> ViewerCamera:
    pose = torch.eye(4)
    pose[0, 3] = x
    return ViewerCamera(pose, 0.7, 1.5)


def _move() -> CameraMove:
    return CameraMove(departure=_camera(0).pose, destination=_camera(2).pose, extent=1.0, start=100.0)


def test_a_camera_that_has_arrived_leaves_by_any_other_place() -> None:
    move = _move()
    assert not move.has_left(_camera(2), 101)
    assert not move.has_left(_camera(2.0005), 102), "a thousandth of the scene's extent is the rounding of the browser"
    assert move.has_left(_camera(2.1), 103)
    assert move.has_left(_camera(0), 103), "back to where it came from"


def test_reports_on_the_way_are_ignored_for_a_while() -> None:
    move = _move()
    assert not move.has_left(_camera(1), 100 + 0.9 * ARRIVAL)
    assert move.has_left(_camera(1), 100 + 1.1 * ARRIVAL), "moved by its user before it got there"


def test_a_late_browser_has_not_left() -> None:
    move = _move()
    assert not move.has_left(_camera(0), 100 + 5 * ARRIVAL), "it reports its old camera as long as it lacks the new one"
    assert not move.has_left(_camera(2), 101 + 5 * ARRIVAL)
    assert move.has_left(_camera(0), 102 + 5 * ARRIVAL)


def _rolled(angle: float, roll: float) -> torch.Tensor:
    """A camera around the z axis that looks at the origin, turned about its own axis by ``roll``."""
    outward = torch.tensor([math.cos(angle), math.sin(angle), 0.4], dtype=torch.float64)
    forward = -outward / outward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 0] = math.cos(roll) * right + math.sin(roll) * down
    pose[:3, 1] = math.cos(roll) * down - math.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = forward, 3 * outward
    return pose.float()


def test_the_orbits_up_direction_does_not_drift() -> None:
    """After any photographs it is the scene's without its part along the last one's x axis."""
    viser = pytest.importorskip("viser")
    client: Any = SimpleNamespace(_websock_connection=SimpleNamespace(queue_message=lambda message: None), atomic=nullcontext)
    camera = client.camera = viser.CameraHandle(client)
    state = camera._state
    state.update_timestamp, state.wxyz, state.up_direction = 1.0, np.array([1.0, 0, 0, 0]), np.array([0.0, 0, 1])
    state.position, state.look_at = np.array([9.0, 0, 0]), np.zeros(3)
    scene, up = toy_scene(views=2, size=4), np.array([0.0, 0, 1])
    for step in range(12):
        pose = _rolled(0.9 * step, 0.3 * math.sin(step))
        send_camera(client, pose, 0.7, scene, (0.0, 0.0, 1.0))
        right = pose[:3, 0].double().numpy()
        np.testing.assert_allclose(camera.up_direction, up - (up @ right) * right, atol=1e-5)
        seen = ViewerCamera.from_viser(tuple(camera.wxyz), tuple(camera.position), 0.7, 1.0)
        assert seen.is_at(pose, 1e-4, 1e-3), "the pose itself is kept"
