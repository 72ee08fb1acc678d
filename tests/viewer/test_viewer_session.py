"""Controls of a session and what follows from them, without a browser that draws."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("viser")

from browser_messages import connect, report, session_of, until

from invgraphics.viewer.launch import ViewerConfig, open_viewer
from invgraphics.viewer.server import Viewer
from invgraphics.viewer.session import Session

PAIR = ("volumetric/hash", "splatting/gaussians")


@pytest.fixture
def viewer(runs: dict[str, Path]) -> Iterator[Viewer]:
    with open_viewer(ViewerConfig(tuple(runs[one] for one in PAIR), port=0), print) as opened:
        yield opened


@contextmanager
def browser(viewer: Viewer, width: int = 700) -> Iterator[Session]:
    """The session of a browser with a window of this width, whose first picture is there."""
    with connect(viewer) as socket:
        report(socket, width, viewer._runs[0].scene.test[0].camera.cam_to_world)
        found = session_of(viewer, width)
        until(lambda: found._frame)
        yield found


@pytest.fixture
def session(viewer: Viewer) -> Iterator[Session]:
    with browser(viewer) as found:
        yield found


def do(session: Session, handler: Coroutine[Any, Any, None]) -> None:
    """Await a handler where viser's are awaited."""
    asyncio.run_coroutine_threadsafe(handler, session._loop).result(30)


def test_lines_are_not_drawn_over_two_pictures(session: Session) -> None:
    session._crop.enabled.value = True
    do(session, session._crop_changed())
    for _ in range(2):
        do(session, session._path._add())
    for layout, shown in (("side by side", False), ("split", True), ("side by side", False), ("first", True)):
        session._controls.layout.value = layout
        do(session, session._output_changed())
        do(session, session._crop_changed())
        do(session, session._path._retime())
        assert (session._crop._outline.visible, session._path._line.visible) == (shown, shown), layout


def test_the_crop_box_is_that_of_the_frame_as_it_is_now(session: Session) -> None:
    """A frame of half the scale holds the same lengths of the world as twice the numbers."""
    session._crop.enabled.value = True
    before = session._crop.box
    run = session._runs[0]
    similarity = run.scene.world_from_local @ torch.diag(torch.tensor([0.5, 0.5, 0.5, 1.0]))
    run.fitted = replace(run.fitted, scene=replace(run.scene, world_from_local=similarity))
    assert session._crop.box.hi == pytest.approx([2 * value for value in before.hi])


def test_a_browser_that_connects_again_has_the_last_path(viewer: Viewer, session: Session) -> None:
    for _ in range(3):
        do(session, session._path._add())
    session._path.loop.value = True
    do(session, session._path._reloop())
    do(session, session._path._delete())
    with browser(viewer, 701) as again:
        assert again is not session
        assert again._path.path is session._path.path
        assert len(again._path.path.keyframes) == 2 and again._path.loop.value and again._path.selected.value == "2 of 2"
        assert again._path._line is not None
        do(again, again._path._delete())
        with browser(viewer, 702) as third:
            assert len(third._path.path.keyframes) == 1
