"""A browser on its way to a photograph: which reported cameras count as leaving it."""

from __future__ import annotations

import torch

from invgraphics.viewer.camera_move import ARRIVAL, CameraMove
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
