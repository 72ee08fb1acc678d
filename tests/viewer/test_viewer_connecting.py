"""A browser that connects slowly, by its messages alone: it reports its own camera until the photograph's reaches it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

pytest.importorskip("viser")

from browser_messages import connect, report, session_of, until

from invgraphics.viewer.launch import ViewerConfig, open_viewer
from invgraphics.viewer.server import Viewer


@pytest.fixture
def viewer(runs: dict[str, Path]) -> Iterator[Viewer]:
    opened = open_viewer(ViewerConfig((runs["splatting/gaussians"],), port=0), print)
    yield opened
    opened.stop()


def _pose(x: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[0, 3] = x
    return pose


def test_reports_from_before_the_first_photograph_do_not_leave_it(viewer: Viewer) -> None:
    photograph = viewer._runs[0].scene.test[0].camera.cam_to_world
    with connect(viewer) as socket:
        report(socket, 700, _pose(3))
        report(socket, 701, _pose(3))  # its panel has opened
        report(socket, 702, photograph)
        report(socket, 703, photograph)
        session = session_of(viewer, 703)
        assert session._view_index == 0, "it was on its way to the photograph, and is there"
        report(socket, 704, _pose(3))
        until(lambda: True if session._view_index is None else None)  # its user has turned away
