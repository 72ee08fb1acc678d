"""Checkpoints during a picture or a film of an earlier one, and errors of pictures: browsers by their messages alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")

from browser_messages import connect, report, session_of, until

from invgraphics.tools.camera_path import CameraPath, Keyframe
from invgraphics.viewer.launch import ViewerConfig, open_viewer
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.server import Viewer


@pytest.fixture
def viewer(runs: dict[str, Path]) -> Iterator[Viewer]:
    opened = open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0), print)
    yield opened
    opened.stop()


class Events(list[str]):
    """What a run was used for, in order; each strip of a picture takes a while, and there always is a newer checkpoint."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
        super().__init__()
        render = LoadedRun.render

        def slow(run: LoadedRun, *arguments: Any) -> Any:
            time.sleep(seconds)
            self.append("render")
            return render(run, *arguments)

        monkeypatch.setattr(LoadedRun, "render", slow)
        monkeypatch.setattr(LoadedRun, "has_update", lambda run: True)
        monkeypatch.setattr(LoadedRun, "reload", lambda run: self.append("reload"))


def test_pictures_slower_than_checkpoints_are_finished(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    events = Events(monkeypatch, 0.03)
    with connect(viewer) as socket:
        report(socket, 700, viewer._runs[0].scene.test[0].camera.cam_to_world)
        session, finished = session_of(viewer, 700), []
        until(lambda: session._frame)
        viewer._shared.renderer.resolutions[viewer._runs[0]].pixels = 100.0  # a picture of 32 x 32 in eleven strips
        end = time.monotonic() + 20
        while len(finished) < 3 and time.monotonic() < end:
            viewer.reload_if_changed()
            time.sleep(0.02)
            if session._frame.final and session._frame not in finished:
                finished.append(session._frame)
    assert len(finished) == 3, "a reload every 0.02 s, a picture in 0.3 s"
    assert events.count("reload") >= 2


def test_a_film_is_of_one_checkpoint(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, films = viewer._runs[0].scene, []
    path = CameraPath(tuple(Keyframe.from_local(view.camera.cam_to_world, 0.7, scene) for view in scene.test[:2]), 0.4)
    with connect(viewer) as socket:
        report(socket, 700, scene.test[0].camera.cam_to_world)
        session = session_of(viewer, 700)
        until(lambda: session._frame if session._frame is not None and session._frame.final else None)
        monkeypatch.setattr(session, "_download", lambda name, content: films.append((name, len(events))))
        events = Events(monkeypatch, 0.03)
        session._export(path)
        until(lambda: events or None)
        before = len(events)
        viewer.reload_if_changed()
        until(lambda: "newer checkpoint" in session._controls._facts.content or None)
        until(lambda: "reload" in events or None)
        until(lambda: "newer checkpoint" not in session._controls._facts.content or None)
    (name, at), first = films[0], events.index("reload")
    assert name.endswith(".mp4") and before < at <= first, "the film was sent before the newer checkpoint was loaded"
    assert events[:first] == ["render"] * first and first >= path.frame_count(24)


def test_a_moving_camera_does_not_delay_a_checkpoint(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarse picture and a pause: nothing is lost."""
    monkeypatch.setattr("invgraphics.viewer.progressive.SETTLE_SECONDS", 1e3)
    viewer._shared.renderer.resolutions[viewer._runs[0]].pixels = 100.0
    with connect(viewer) as socket:
        report(socket, 700, viewer._runs[0].scene.test[0].camera.cam_to_world)
        session = session_of(viewer, 700)
        until(lambda: session._frame)
        assert not session._frame.final
        events = Events(monkeypatch, 0.0)
        viewer.reload_if_changed()
        until(lambda: "reload" in events or None, 5)


def test_a_failed_picture_is_named_in_the_panel(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> Any:
        raise OSError("the disk is gone")

    monkeypatch.setattr(LoadedRun, "render", fail)
    with connect(viewer) as socket:
        report(socket, 700, viewer._runs[0].scene.test[0].camera.cam_to_world)
        status = session_of(viewer, 700)._controls._status
        until(lambda: "could not be made: OSError: the disk is gone" in status.content or None)


def test_a_reloaded_photograph_is_gone_to_where_reports_of_cameras_arrive(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As viser exchanges a camera's state whenever one is reported, another thread would write to a state that is gone."""
    threads: list[threading.Thread] = []
    with connect(viewer) as socket:
        report(socket, 700, viewer._runs[0].scene.test[0].camera.cam_to_world)
        session = session_of(viewer, 700)
        until(lambda: session._frame)
        session._loop.call_soon_threadsafe(lambda: threads.append(threading.current_thread()))
        monkeypatch.setattr(session._overlays, "remove_outdated", lambda: True)
        monkeypatch.setattr(session, "go_to_view", lambda index: threads.append(threading.current_thread()))
        Events(monkeypatch, 0.0)
        viewer.reload_if_changed()
        until(lambda: len(threads) > 1 or None)
    assert threads[0] is threads[1] is not viewer._worker
