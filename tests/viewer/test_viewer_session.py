"""Controls of a session and what follows from them, without a browser that draws."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
import torch

pytest.importorskip("viser")

from browser_messages import connect, report, session_of, until

from invgraphics.experiments.fitted import open_fitted
from invgraphics.tools.camera_path import Keyframe
from invgraphics.viewer.controls import FOVS, FREE_CAMERA
from invgraphics.viewer.launch import ViewerConfig, open_viewer
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.overlays import add_splats
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


def test_splats_of_the_browser_are_those_of_the_run_that_is_shown(
    viewer: Viewer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first run of the pair has none; where both have some, the second's are drawn if it is shown alone."""
    hash_grid, gaussians = viewer._runs
    controls, status, images = session._controls, session._controls._status, []
    assert controls.splats.visible
    monkeypatch.setattr(session._client.scene, "set_background_image", lambda image, **_: images.append(image))
    controls.layout.value, controls.splats.value = "first", True
    do(session, session._overlays_changed())
    until(lambda: session._overlays._splats.get(gaussians))
    until(lambda: "These are the splats of splatting/gaussians." in status.content or None)
    assert "Without effect on them: Runs." in status.content
    controls.layout.value, controls.background.value, session._crop.enabled.value = "second", "black", True
    controls.output.value = "depth"
    do(session, session._output_changed())
    until(lambda: "Without effect on them: Show, Crop." in status.content or None)
    assert images[-1].max() == 0
    monkeypatch.setattr(type(hash_grid), "has_gaussians", True)
    assert controls.splat_run is gaussians
    controls.layout.value = "split"
    assert controls.splat_run is hash_grid
    controls.splats.value = False
    assert controls.splat_run is None


def test_splats_of_a_run_in_another_frame_are_drawn_in_the_first_ones(runs: dict[str, Path]) -> None:
    """Centres c become M c + t, covariances M S M^T."""
    run = LoadedRun(open_fitted(runs["splatting/gaussians"]))
    similarity = torch.tensor([[0.0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, -1], [0, 0, 0, 1.0]])
    scene = replace(run.scene, world_from_local=similarity)
    drawn: list[dict[str, Any]] = []
    page: Any = SimpleNamespace(add_gaussian_splats=lambda name, **settings: drawn.append(settings))
    add_splats(run, page, "/own", run.scene)
    add_splats(run, page, "/other", scene)
    own, other = drawn
    inverse = np.linalg.inv(similarity.double().numpy())
    world = run.scene.world_from_local.double().numpy()
    to = inverse @ world
    centres = own["centers"] * own["scale"] @ to[:3, :3].T + to[:3, 3]
    np.testing.assert_allclose(other["centers"] * other["scale"], centres, atol=1e-4)
    covariances = to[:3, :3] @ (own["covariances"] * own["scale"] ** 2) @ to[:3, :3].T
    np.testing.assert_allclose(other["covariances"] * other["scale"] ** 2, covariances, atol=1e-3 * np.abs(covariances).max())
    np.testing.assert_allclose(other["rgbs"], own["rgbs"], atol=1e-5)


def test_the_field_of_view_is_chosen_and_shown(viewer: Viewer, session: Session) -> None:
    """At a photograph it is the letterbox's; choosing another one frees the camera where it stands."""
    pose = viewer._runs[0].scene.test[0].camera.cam_to_world
    shown = math.degrees(session._client.camera.fov)
    assert session._controls.fov.value == round(shown)
    session._controls.fov.value = 20
    do(session, session._fov_changed())
    assert (session._view_index, session._controls.view.value) == (None, FREE_CAMERA)
    assert session._client.camera.fov == pytest.approx(math.radians(20))
    camera = session._latest.camera
    assert camera.fov == pytest.approx(math.radians(20)) and camera.is_at(pose, 1e-4, 1e-3) and session._latest.view is None
    session._move_to(Keyframe.from_local(pose, math.radians(33.2), session._scene))
    assert session._controls.fov.value == 33
    session._move_to(Keyframe.from_local(pose, math.radians(1), session._scene))
    assert session._controls.fov.value == FOVS[0] and session._client.camera.fov == pytest.approx(math.radians(1))


@pytest.mark.parametrize(
    ("shape", "rate", "most", "size", "count"), [("photograph", 24, 96, (32, 32), 13), ("window", 10, 70, (70, 50), 6)]
)
def test_films_have_the_chosen_shape_and_rate(
    session: Session,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    shape: str,
    rate: int,
    most: int,
    size: object,
    count: int,
) -> None:
    """Half a second, read back by ffmpeg; the window has 700 x 500 pixels."""
    films: list[bytes] = []
    monkeypatch.setattr(session, "_download", lambda name, content: films.append(content))
    path = session._path
    for _ in range(2):
        do(session, path._add())
    path.shape.value, path.rate.value, path.seconds.value, session._controls.max_size.value = shape, rate, 0.5, most
    do(session, path._retime())
    session._export(path.path)
    until(lambda: films or None)
    (tmp_path / "film.mp4").write_bytes(films[0])
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    facts = next(reader)
    assert (facts["size"], facts["fps"], sum(1 for _ in reader)) == (size, rate, count)
