"""Camera paths while they play, and errors of films, without a browser."""

import asyncio
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from invgraphics.testing import toy_scene
from invgraphics.tools.camera_path import Keyframe
from invgraphics.viewer.path_panel import PathCallbacks, PathPanel
from invgraphics.viewer.server import Viewer


class Control:
    """A control of the page, which remembers what it shows."""

    def __init__(self, label: str = "", value: Any = None, options: Any = ()) -> None:
        self.label, self.value, self.options, self.content = label, value, options, ""

    def on_click(self, handler: Any) -> None:
        """Handlers are called directly here."""

    on_update = on_click


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

    def add_html(self, content: str) -> Control:
        return Control()


def panel(moves: list[Keyframe]) -> PathPanel:
    places = iter(range(1, 10))

    def current() -> Keyframe:
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = next(places)
        return Keyframe(pose, 1.0)

    callbacks = PathCallbacks(current, moves.append, lambda path: None, lambda: None, lambda name, content: None)
    drawn = SimpleNamespace(add_line_segments=lambda *_, **__: SimpleNamespace(visible=True, remove=lambda: None))
    return PathPanel(Page(), drawn, toy_scene(views=2, size=4), callbacks)


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("left", [0, 1, 2])
def test_a_path_that_becomes_too_short_stops_playing(loop: bool, left: int) -> None:
    async def play() -> None:
        path = panel([])
        for _ in range(3):
            await path._add()
        path.loop.value = loop
        await path._retime()
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
