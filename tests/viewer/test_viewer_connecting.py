"""A browser that connects slowly, by its messages alone: it reports its own camera until the photograph's reaches it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch

viser = pytest.importorskip("viser")

import msgspec  # noqa: E402
from viser._messages import ViewerCameraMessage  # noqa: E402
from websockets.sync.client import connect  # noqa: E402
from websockets.sync.connection import Connection  # noqa: E402
from websockets.typing import Subprotocol  # noqa: E402

from invgraphics.viewer.cameras import rotation_quaternion  # noqa: E402
from invgraphics.viewer.launch import ViewerConfig, open_viewer  # noqa: E402
from invgraphics.viewer.server import Viewer  # noqa: E402
from invgraphics.viewer.session import Session  # noqa: E402

PATIENCE = 30
Found = TypeVar("Found")


@pytest.fixture
def viewer(runs: dict[str, Path]) -> Iterator[Viewer]:
    opened = open_viewer(ViewerConfig((runs["splatting/gaussians"],), port=0), print)
    yield opened
    opened.stop()


def _pose(x: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[0, 3] = x
    return pose


def _report(socket: Connection, width: int, pose: torch.Tensor) -> None:
    """Send what viser's page sends whenever its camera or its window changes."""
    message: dict[str, Any] = {
        "type": ViewerCameraMessage.__name__,
        "wxyz": rotation_quaternion(pose),
        "position": pose[:3, 3].tolist(),
        "fov": 0.9,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 500,
        "image_width": width,
        "look_at": (pose[:3, 3] + pose[:3, 2]).tolist(),
        "up_direction": (0.0, -1.0, 0.0),
    }
    socket.send(msgspec.msgpack.encode(message))


def _session(viewer: Viewer, width: int) -> Session:
    """The session whose browser reported a window of this width; the handlers of its earlier reports have run."""
    return _until(lambda: next((one for one in tuple(viewer._sessions.values()) if one._window[0] == width), None))


def _until(found: Callable[[], Found | None]) -> Found:
    deadline = time.monotonic() + PATIENCE
    while (value := found()) is None:
        assert time.monotonic() < deadline, "the viewer did not get there"
        time.sleep(0.02)
    return value


def test_reports_from_before_the_first_photograph_do_not_leave_it(viewer: Viewer) -> None:
    photograph = viewer._runs[0].scene.test[0].camera.cam_to_world
    with connect(
        f"ws://127.0.0.1:{viewer.port}", subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None
    ) as socket:
        _report(socket, 700, _pose(3))
        _report(socket, 701, _pose(3))  # its panel has opened
        _report(socket, 702, photograph)
        _report(socket, 703, photograph)
        session = _session(viewer, 703)
        assert session._view_index == 0, "it was on its way to the photograph, and is there"
        _report(socket, 704, _pose(3))
        _until(lambda: True if session._view_index is None else None)  # its user has turned away
