"""Camera paths while they play, and errors of films, without a browser."""

import asyncio
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from invgraphics.core import Scene
from invgraphics.testing import toy_scene
from invgraphics.tools.camera_path import CameraPath, Keyframe
from invgraphics.viewer.path_panel import PathCallbacks, PathPanel
from invgraphics.viewer.server import Viewer


class Control:
    """A control of the page, which remembers what it shows."""

    def __init__(self, label: str = "", value: Any = None, options: Any = ()) -> None:
        self.label, self.value, self.options, self.content = label, value, options, ""

    def on_click(self, handler: Any) -> None:
        """Handlers are called directly here."""

    on_update = on_upload = on_click


class Page:
    """As much of viser's interface as the panel uses."""

    def add_folder(self, *_: Any, **__: Any) -> Any:
        return nullcontext()

    def add_button(self, label: str, **_: Any) -> Control:
        return Control(label)

    def add_dropdown(self, label: str, options: Any, **_: Any) -> Control:
        return Control(label, options[0], options)

    def add_slider(self, label: str, *values: Any, **_: Any) -> Control:
        return Control(label, values[3])

    def add_checkbox(self, label: str, value: bool, **_: Any) -> Control:
        return Control(label, value)

    def add_upload_button(self, label: str, **_: Any) -> Control:
        return Control(label, SimpleNamespace(name="", content=b""))

    def add_html(self, content: str) -> Control:
        return Control()


def panel(moves: list[Keyframe], scene: Callable[[], Scene] | None = None) -> PathPanel:
    places = iter(range(1, 10))

    def current() -> Keyframe:
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = next(places)
        return Keyframe(pose, 1.0)

    callbacks = PathCallbacks(
        current, moves.append, lambda path: None, lambda: None, lambda name, content: None, lambda path: None
    )

    def add_line_segments(name: str, points: Any, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(visible=True, remove=lambda: None, points=points)

    toy = toy_scene(views=2, size=4)
    return PathPanel(
        Page(), SimpleNamespace(add_line_segments=add_line_segments), scene or (lambda: toy), CameraPath(()), callbacks
    )


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("left", [0, 1, 2])
def test_a_path_that_becomes_too_short_stops_playing(loop: bool, left: int) -> None:
    async def play() -> None:
        path = panel([])
        for _ in range(3):
            await path._add()
        path.loop.value = loop
        await path._reloop()
        await path._toggle_play()
        playing = cast("asyncio.Task[None]", path._playing)
        await asyncio.sleep(0.12)
        for _ in range(3 - left):
            await path._delete()
        await asyncio.sleep(0.12)
        assert (path._playing is None, path._play.label) == ((False, "Stop") if left == 2 else (True, "Play"))
        if left == 2:
            path.close()
            await asyncio.sleep(0)
        assert playing.cancelled()

    asyncio.run(play())


def test_the_selected_keyframe_can_be_returned_to() -> None:
    moves: list[Keyframe] = []
    path = panel(moves)
    asyncio.run(path._add())
    asyncio.run(path._return())
    assert [float(keyframe.pose[0, 3]) for keyframe in moves] == [1.0]


def test_a_saved_path_is_loaded_and_a_bad_file_named() -> None:
    path = panel([])
    for _ in range(3):
        asyncio.run(path._add())
    path.path = replace(path.path, seconds=40.0, loop=True)  # longer than the slider can set
    text, other = path.path.to_json(), panel([])
    other._upload.value = SimpleNamespace(name="mine.json", content=text.encode())
    asyncio.run(other._load())
    assert other.path.to_json() == text
    assert (other.selected.value, other.loop.value, other.seconds.value) == ("3 of 3", True, 10.0)
    assert "3 keyframes, 120.0 s" in other._status.content and "Loaded mine.json." in other._status.content
    other.loop.value = False
    asyncio.run(other._reloop())
    assert (other.path.seconds, other.path.loop) == (40.0, False), "only what was changed changes"
    kept = other.path
    for content, words in (
        (b"\xff\xfe", "is no text"),
        (b"{", "is not valid JSON"),
        (b"[]", "has no &quot;kind&quot;"),
        (text.replace("40.0", "-1").encode(), "has seconds_between_keyframes -1"),
    ):
        other._upload.value = SimpleNamespace(name="mine.json", content=content)
        asyncio.run(other._load())
        assert words in other._status.content and "mine.json" in other._status.content, other._status.content
        assert other._status.content.count("<div>") == 2, "the path's length, and one sentence"
        assert other.path is kept


def test_the_drawn_path_is_hidden_while_it_plays_and_on_demand() -> None:
    async def play() -> None:
        path = panel([])
        for _ in range(2):
            await path._add()
        assert path._line.visible
        await path._toggle_play()
        assert not path._line.visible
        await path._retime()
        assert not path._line.visible, "another line, of the same path"
        path.show_line(False)
        await path._toggle_play()
        assert not path._line.visible
        await path._add()
        assert not path._line.visible
        path.show_line(True)
        assert path._line.visible

    asyncio.run(play())


def test_the_path_is_drawn_where_the_frame_has_it_now() -> None:
    """Keyframes are in the world: in a frame of half the scale, moved by (1, 2, 3), they are elsewhere."""
    scenes = [toy_scene(views=2, size=4)]
    path = panel([], lambda: scenes[-1])
    for _ in range(2):
        asyncio.run(path._add())
    np.testing.assert_allclose(path._line.points[0, 0], [1, 0, 0], atol=1e-6)
    similarity = torch.diag(torch.tensor([0.5, 0.5, 0.5, 1.0]))
    similarity[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    scenes.append(replace(scenes[0], world_from_local=similarity))
    path.draw()
    np.testing.assert_allclose(path._line.points[0, 0], [0, -4, -6], atol=1e-6)
    np.testing.assert_allclose(path._line.points[-1, 1], [2, -4, -6], atol=1e-6)


def test_an_error_is_shown_to_whom_it_concerns(capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[tuple[int, str, str]] = []

    def session(number: int) -> Any:
        return SimpleNamespace(show_error=lambda task, sentence: shown.append((number, task, sentence)))

    viewer = cast(Any, SimpleNamespace(_sessions={number: session(number) for number in (4, 5)}))
    Viewer._report_error(viewer, ("film", 5), OSError("No space left"))
    assert shown == [(5, "film", "OSError: No space left")]
    Viewer._report_error(viewer, "reload", OSError("gone"))
    assert [number for number, *_ in shown[1:]] == [4, 5]
    assert "No space left" in capsys.readouterr().err
