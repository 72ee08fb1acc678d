"""Web server of the viewer. Imports viser, so `viewer.launch` imports it only where that is installed."""

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
from invgraphics.viewer.cameras import LetterboxedView
from invgraphics.viewer.host_check import HostCheck
from invgraphics.viewer.loaded_run import POLL, LoadedRun
from invgraphics.viewer.overlays import CameraFrustums
from invgraphics.viewer.progressive import ProgressiveRenderer
from invgraphics.viewer.render_thread import RenderThread, Task
from invgraphics.viewer.session import Session
from invgraphics.viewer.shared_state import SharedState

UP = (0.0, 0.0, 1.0)
"""Default up direction of the local frame."""
HELD = 0.05
"""Seconds between two looks at whether a reload may go ahead."""
UP_AGREEMENT = 0.5
"""Cosine of the angle to the photographs' mean up direction above which the default is kept."""


class LocalServer(viser.ViserServer):
    """Viser's server without share URLs: no browser can open this machine to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return no URL."""
        return None


@dataclass(frozen=True)
class Address:
    """Address and port of the server.

    Attributes:
        host: address to listen at; a loopback address is reachable from this machine only.
        port: port, 0 for any that is free.
        allowed: further names at which browsers reach it, see `HostCheck.allowed`.
    """

    host: str
    port: int
    allowed: tuple[str, ...] = ()


class Viewer:
    """A running viewer; a context manager that stops it.

    Args:
        runs: one run, or two of one scene.
        address: of the server.
        view: initial test view.
        max_size: initial limit of the longer side, pixels.

    Raises:
        InputError: the port is in use, or this version of viser cannot be made to check the Host header.
    """

    def __init__(self, runs: Sequence[LoadedRun], address: Address, view: int, max_size: int) -> None:
        self._runs = runs
        scene = runs[0].scene
        self._worker = RenderThread(self._report_error)
        frustums = CameraFrustums(runs[0])
        self._shared = SharedState(ProgressiveRenderer(runs), self._worker, frustums, view, max_size, upward(scene))
        self._sessions: dict[int, Session] = {}
        self._reloading = False
        check = HostCheck(address.host, address.allowed)
        with redirect_stdout(io.StringIO()), check.applied():  # the command prints the address itself
            self._server = LocalServer(address.host, address.port, label=" | ".join(s.name for s in runs), verbose=False)
        if address.port and self._server.get_port() != address.port:  # viser falls back to the next port
            self.stop()
            raise port_in_use(address)
        if not check.active:
            self.stop()
            raise InputError(
                f"viser {viser.__version__} starts its server so that invgraphics cannot guard it against other sites' pages.",
                "`pip install 'viser==1.1.*'`",
            )
        self._configure_scene(scene)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self._worker.start()

    @property
    def port(self) -> int:
        """The port in use."""
        return self._server.get_port()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def stop(self) -> None:
        """Stop the server and the render thread."""
        self._worker.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def serve(self, live: bool) -> None:
        """Block until interrupted; if ``live``, reload every new checkpoint."""
        while True:
            time.sleep(POLL)
            if live:
                self.reload_if_changed()

    def reload_if_changed(self) -> None:
        """Reload the runs whose checkpoint or scores have changed on disk, once no picture or film of the old ones is made."""
        if not self._reloading and any(run.has_update() for run in self._runs):
            self._reloading = True
            self._worker.submit("reload", self._reload())

    def _reload(self) -> Task:
        """Task that loads what is newest after the pictures and films in progress; a camera that moves does not delay it.

        Checkpoints may come faster than pictures: each would end the picture of the one before, and none would be finished.
        """
        try:
            told = False
            while tasks := {key[0] for key in self._worker.at_work() if isinstance(key, tuple)} & {"frame", "film"}:
                if "film" in tasks and not told:
                    told = True
                    for session in tuple(self._sessions.values()):
                        session.show_held()
                yield HELD
            for run in self._runs:
                if run.has_update():
                    run.reload()
            for session in tuple(self._sessions.values()):
                session.refresh()
        finally:
            self._reloading = False

    def _configure_scene(self, scene: Scene) -> None:
        server = self._server
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(self._shared.up)
        camera = scene.test[self._shared.start].camera
        first = server.initial_camera  # also where "Reset view" leads
        first.position = camera.position.double().numpy()
        first.look_at = (camera.position + camera.cam_to_world[:3, 2] * scene.bounds.radius).double().numpy()
        first.fov = LetterboxedView.fit(camera, camera.width / camera.height).fov

    async def _connected(self, client: viser.ClientHandle) -> None:
        self._sessions[client.client_id] = Session(client, self._shared)

    async def _disconnected(self, client: viser.ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _report_error(self, key: Hashable, error: Exception) -> None:
        sentence = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        print(f"The viewer: {sentence}", file=sys.stderr, flush=True)
        task, client = key if isinstance(key, tuple) else (key, None)
        for number, session in tuple(self._sessions.items()):
            if client in (None, number):
                session.show_error(str(task), sentence)


def upward(scene: Scene) -> tuple[float, float, float]:
    """Up direction of the orbit controls: +z of the local frame, or the photographs' mean up direction if that disagrees."""
    ups = -torch.stack([view.camera.cam_to_world[:3, 1] for view in scene.train])
    mean = torch.nn.functional.normalize(ups.mean(dim=0), dim=0)
    if float(mean @ torch.tensor(UP)) >= UP_AGREEMENT:
        return UP
    x, y, z = mean.tolist()
    return x, y, z


def port_in_use(address: Address) -> InputError:
    """The error for a port that is in use."""
    return InputError(f"Port {address.port} at {address.host} is in use.", "Choose another --port, or 0 for any that is free.")
