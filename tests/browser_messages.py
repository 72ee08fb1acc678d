"""A browser by its messages alone: what viser's page sends, over a WebSocket."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
import torch
import viser
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect as connect_socket
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from invgraphics.viewer.cameras import rotation_quaternion
from invgraphics.viewer.server import Viewer
from invgraphics.viewer.session import Session

PATIENCE = 30
Found = TypeVar("Found")


def connect(viewer: Viewer) -> Connection:
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    return connect_socket(f"ws://127.0.0.1:{viewer.port}", subprotocols=[protocol], max_size=None)


def report(socket: Connection, width: int, pose: torch.Tensor) -> None:
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


def session_of(viewer: Viewer, width: int) -> Session:
    """The session whose browser reported a window of this width; the handlers of its earlier reports have run."""
    return until(lambda: next((one for one in tuple(viewer._sessions.values()) if one._window[0] == width), None))


def until(found: Callable[[], Found | None], seconds: float = PATIENCE) -> Found:
    deadline = time.monotonic() + seconds
    while (value := found()) is None:
        assert time.monotonic() < deadline, "the viewer did not get there"
        time.sleep(0.02)
    return value
