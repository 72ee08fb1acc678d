"""The web server of the viewer, and its life. Imports viser, so it is imported by `viewer.view` when that is there."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Hashable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import torch
import viser

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.viewer.cameras import Mount
from invgraphics.viewer.drawn import Photographs
from invgraphics.viewer.painting import Painter
from invgraphics.viewer.session import Session, Stage
from invgraphics.viewer.subject import POLL, Subject
from invgraphics.viewer.worker import Job, Worker

UP = (0.0, 0.0, 1.0)
"""The local frame's upward direction, unless the photographs say otherwise."""
AGREES = 0.5
"""Cosine of the angle up to which they do not."""


class LocalServer(viser.ViserServer):
    """Viser's server, that no browser can ask to open this machine to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing is shared."""
        return None


@dataclass(frozen=True)
class Place:
    """Where the viewer listens.

    Attributes:
        host: address to listen at; a loopback address is reachable from this machine only.
        port: port, 0 for any that is free.
    """

    host: str
    port: int


class Viewer:
    """A running viewer; ends with its context.

    Args:
        subjects: one run, or two of one scene.
        place: where to listen.
        view: test view at which browsers start.
        longest: most pixels along a picture's longest side, at the start.
    """

    def __init__(self, subjects: Sequence[Subject], place: Place, view: int, longest: int) -> None:
        self._subjects = subjects
        scene, views = subjects[0].scene, subjects[0].views()
        self._worker = Worker(self._complain)
        self._stage = Stage(Painter(subjects), self._worker, views, Photographs(views, scene), view, longest)
        self._sessions: dict[int, Session] = {}
        with redirect_stdout(io.StringIO()):  # it announces itself; we say where it is
            self._server = LocalServer(place.host, place.port, label=" | ".join(s.name for s in subjects), verbose=False)
        if place.port and self._server.get_port() != place.port:  # it takes the next one, unasked
            self.stop()
            raise port_taken(place)
        self._arrange(scene)
        self._server.on_client_connect(self._came)
        self._server.on_client_disconnect(self._went)
        self._worker.start()

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return self._server.get_port()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server and the thread that renders."""
        self._worker.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def watch(self, live: bool) -> None:
        """Wait for the end of the process; if ``live``, load every checkpoint that a fit writes meanwhile."""
        while True:
            time.sleep(POLL)
            if live:
                self.look_for_news()

    def look_for_news(self) -> None:
        """Load and show the newest checkpoints, if there are any that are not shown."""
        if any(subject.changed() for subject in self._subjects):
            self._worker.submit("news", self._reload())

    def _reload(self) -> Job:
        for subject in self._subjects:
            if subject.changed():
                subject.refresh()
        for session in tuple(self._sessions.values()):
            session.renew()
        yield 0.0

    def _arrange(self, scene: Scene) -> None:
        server = self._server
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(upward(scene))
        camera = scene.test[self._stage.start].camera
        first = server.initial_camera  # also where "Reset view" leads
        first.position = camera.position.double().numpy()
        first.look_at = (camera.position + camera.cam_to_world[:3, 2] * scene.bounds.radius).double().numpy()
        first.fov = Mount.of(camera, camera.width / camera.height).fov

    async def _came(self, client: viser.ClientHandle) -> None:
        self._sessions[client.client_id] = Session(client, self._stage)

    async def _went(self, client: viser.ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.end()

    def _complain(self, key: Hashable, error: Exception) -> None:
        sentence = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        print(f"The viewer: {sentence}", file=sys.stderr, flush=True)
        for session in tuple(self._sessions.values()):
            session.complain(sentence)


def upward(scene: Scene) -> tuple[float, float, float]:
    """The direction around which browsers turn: +z of the local frame, or the photographs' own, if that is another."""
    ups = -torch.stack([view.camera.cam_to_world[:3, 1] for view in scene.train])
    mean = torch.nn.functional.normalize(ups.mean(dim=0), dim=0)
    if float(mean @ torch.tensor(UP)) >= AGREES:
        return UP
    x, y, z = mean.tolist()
    return x, y, z


def port_taken(place: Place) -> InputError:
    """What to say about a port that is in use."""
    return InputError(f"Port {place.port} at {place.host} is in use.", "Choose another --port, or 0 for any that is free.")
