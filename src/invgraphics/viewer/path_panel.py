"""Controls of the camera path: keyframes, playing, saving, and exporting a film."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.tools.camera_path import CameraPath, Keyframe, parse_camera_path, with_keyframe, without
from invgraphics.viewer.controls import status_block
from invgraphics.viewer.film_export import RATE, SHAPES

NONE = "none yet"
"""Entry of the list without keyframes."""
PLAY_RATE = 20
"""Cameras per second that are sent to a browser while a path plays."""
ECHO = 0.5
"""Seconds after a change of the list within which selections are the browser's echoes of it."""
SAMPLES = 24
"""Segments of the drawn path between two keyframes."""
SECONDS = 0.2, 10.0
"""Range of the time between keyframes that can be set; a file may have another."""
LINE = (0, 158, 115)
SHAPE = "The photographs' or the window's. The field of view from top to bottom is the keyframes'."
FILM = "An MP4 file at full size: of one run, the second where that is shown alone, and of its prediction for truth and error."


@dataclass(frozen=True)
class PathCallbacks:
    """What the panel needs of its session.

    Attributes:
        current: the browser's camera as a keyframe.
        move: sends the browser's camera to a keyframe.
        export: starts the export of a film; progress is shown with `PathPanel.show_status`.
        stop_export: cancels it.
        download: sends a file to the browser.
        changed: takes the path after each change.
    """

    current: Callable[[], Keyframe]
    move: Callable[[Keyframe], None]
    export: Callable[[CameraPath], None]
    stop_export: Callable[[], None]
    download: Callable[[str, bytes], None]
    changed: Callable[[CameraPath], None]


class PathPanel:
    """Folder of controls that edits, plays, saves and exports one camera path.

    Args:
        gui: viser's interface of a browser.
        viser_scene: where the path is drawn.
        scene: gives that of the first run, whose frame may change with its checkpoint.
        path: to begin with.
        callbacks: of the session.
    """

    def __init__(
        self, gui: Any, viser_scene: Any, scene: Callable[[], Scene], path: CameraPath, callbacks: PathCallbacks
    ) -> None:
        self._viser_scene, self._scene, self._callbacks = viser_scene, scene, callbacks
        self.path = path
        self._playing: asyncio.Task[None] | None = None
        self._exporting = False
        self._listed, self._listed_at = NONE, 0.0
        self._line: Any = None
        self._line_shown = True
        with gui.add_folder("Camera path", expand_by_default=False):
            add = gui.add_button("Add keyframe", hint="The current view, after the keyframe that is selected below.")
            self.selected = gui.add_dropdown("Keyframe", (NONE,), hint="Selecting another one goes there.")
            back = gui.add_button("Go to keyframe", hint="The selected one.")
            delete = gui.add_button("Delete keyframe")
            self.seconds = gui.add_slider("Seconds between", *SECONDS, 0.1, CameraPath(()).seconds)
            self.loop = gui.add_checkbox("Loop", False, hint="Returns to the first keyframe.")
            self._play = gui.add_button("Play")
            save = gui.add_button("Save path", hint="A JSON file, for `invgraphics render RUN --path FILE.json`.")
            self._upload = gui.add_upload_button("Load path", hint="A file of Save path.", mime_type="application/json")
            self.shape = gui.add_dropdown("Film shape", SHAPES, hint=SHAPE)
            self.rate = gui.add_slider("Frames per second", 1, 60, 1, RATE, hint="Of the film.")
            self._export = gui.add_button("Export film", hint=FILM)
            self._status = gui.add_html("")
        for button, handler in (
            (add, self._add),
            (back, self._return),
            (delete, self._delete),
            (self._play, self._toggle_play),
            (save, self._save),
            (self._export, self._toggle_export),
        ):
            button.on_click(_ignoring_event(handler))
        self._upload.on_upload(_ignoring_event(self._load))
        for handle, handler in ((self.selected, self._go), (self.seconds, self._retime), (self.loop, self._reloop)):
            handle.on_update(_by_user(handler))
        self._take(path)

    def show_status(self, line: str, exporting: bool | None = None) -> None:
        """Show the path's length and a line of text; ``exporting`` switches the export button."""
        count = len(self.path.keyframes)
        facts = f"{count} keyframe{'s' * (count != 1)}, {self.path.duration:.1f} s" if count else "No keyframes yet."
        self._status.content = status_block("".join(f"<div>{escape(text)}</div>" for text in (facts, line) if text))
        if exporting is not None:
            self._exporting = exporting
            self._export.label = "Stop export" if exporting else "Export film"

    def show_line(self, shown: bool) -> None:
        """Show or hide the drawn path; while it plays it is hidden."""
        self._line_shown = shown
        if self._line is not None:
            self._line.visible = shown and self._playing is None

    def close(self) -> None:
        """Stop playing."""
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None

    @property
    def _index(self) -> int | None:
        return None if self.selected.value == NONE else int(self.selected.value.split()[0]) - 1

    async def _add(self) -> None:
        index = self._index
        self.path = with_keyframe(self.path, self._callbacks.current(), index)
        self._list(0 if index is None else index + 1)

    async def _delete(self) -> None:
        if (index := self._index) is not None:
            self.path = without(self.path, index)
            self._list(max(0, index - 1))

    def _list(self, selected: int) -> None:
        names = [f"{index + 1} of {len(self.path.keyframes)}" for index in range(len(self.path.keyframes))]
        self.selected.options = tuple(names) or (NONE,)
        self._listed = self.selected.value = names[selected] if names else NONE
        self._listed_at = time.monotonic()
        self._changed()

    async def _go(self) -> None:
        # A browser echoes what the program lists: the first of the new options, none at all, and the selection.
        if self.selected.value in (self._listed, NONE) or time.monotonic() - self._listed_at < ECHO:
            return
        self._listed = self.selected.value
        await self._return()

    async def _return(self) -> None:
        if (index := self._index) is not None:
            self._callbacks.move(self.path.keyframes[index])

    async def _retime(self) -> None:
        self.path = replace(self.path, seconds=float(self.seconds.value))
        self._changed()

    async def _reloop(self) -> None:
        self.path = replace(self.path, loop=bool(self.loop.value))
        self._changed()

    async def _load(self) -> None:
        file = self._upload.value
        try:
            path = parse_camera_path(file.content, file.name)
        except InputError as error:
            self.show_status(error.sentence)
            return
        self._take(path)
        self.show_status(f"Loaded {file.name}.")

    def _take(self, path: CameraPath) -> None:
        """Edit ``path`` from now on, its last keyframe selected."""
        self.path = path
        self.seconds.value, self.loop.value = min(max(path.seconds, SECONDS[0]), SECONDS[1]), path.loop
        self._list(len(path.keyframes) - 1)

    def _changed(self) -> None:
        """Update status and drawing, hand the path on, and stop one that plays and has become too short."""
        self.show_status("")
        self._callbacks.changed(self.path)
        if self._playing is not None and len(self.path.keyframes) < 2:
            self.close()
            self._stopped()
        self.draw()

    def draw(self) -> None:
        """Draw the path where the scene's frame has it now."""
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(self.path.keyframes) > 1:
            scene = self._scene()
            times = np.linspace(0, self.path.duration, SAMPLES * len(self.path.keyframes))
            places = np.stack([one.local_pose(scene)[:3, 3].numpy() for one in self.path.at(times)])
            segments = np.stack([places[:-1], places[1:]], axis=1)
            self._line = self._viser_scene.add_line_segments(
                "/camera-path", segments, LINE, thickness=2.0, thickness_units="screen"
            )
            self.show_line(self._line_shown)

    async def _toggle_play(self) -> None:
        if self._playing is not None:
            self.close()
            self._stopped()
        elif len(self.path.keyframes) < 2:
            self.show_status("Playing needs two keyframes.")
        else:
            self._play.label = "Stop"
            self._playing = asyncio.get_running_loop().create_task(self._run())
            self.show_line(self._line_shown)

    async def _run(self) -> None:
        began = time.monotonic()
        while (at := time.monotonic() - began) < self.path.duration or self.path.loop:
            self._callbacks.move(self.path.at(np.array([at % self.path.duration]))[0])
            await asyncio.sleep(1 / PLAY_RATE)
        self._callbacks.move(self.path.keyframes[-1])
        self._playing = None
        self._stopped()

    def _stopped(self) -> None:
        self._play.label = "Play"
        self.show_line(self._line_shown)

    async def _save(self) -> None:
        if self.path.keyframes:
            self._callbacks.download(f"{self._scene().name}-path.json", self.path.to_json().encode())
        else:
            self.show_status("Saving needs a keyframe.")

    async def _toggle_export(self) -> None:
        if self._exporting:
            self._callbacks.stop_export()
            self.show_status("Export stopped.", exporting=False)
        elif self.path.keyframes:
            self.show_status("Exporting …", exporting=True)
            self._callbacks.export(self.path)
        else:
            self.show_status("A film needs a keyframe.")


def _ignoring_event(handler: Any) -> Any:
    async def called(_: Any) -> None:
        await handler()

    return called


def _by_user(handler: Any) -> Any:
    """Call ``handler`` for changes by the user, not by the program."""

    async def called(event: Any) -> None:
        if event.client is not None:
            await handler()

    return called
