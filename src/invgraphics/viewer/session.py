"""One browser: its controls, where it stands, and what it sees."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from invgraphics.core import Scene, View
from invgraphics.experiments.evaluate import display
from invgraphics.viewer.cameras import Gaze, Mount, limited, quaternion
from invgraphics.viewer.colouring import OF_VIEWS
from invgraphics.viewer.controls import ANYWHERE, BACKGROUNDS, Answers, Controls
from invgraphics.viewer.drawn import Photographs, draw_splats
from invgraphics.viewer.painting import Order, Painted, Painter
from invgraphics.viewer.worker import Job, Worker

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

NEAR_ENOUGH = 1e-3
"""How far from a photograph's camera a browser may be to count as standing there: radians, and of the scene's extent."""
ARRIVAL = 10.0
"""Seconds within which a browser that is sent to a photograph gets there."""

RENDERING = "Rendering …"
"""Said until there is a first picture of something else than before."""


@dataclass(frozen=True, eq=False)
class Stage:
    """What all browsers share.

    Attributes:
        painter: of the runs.
        worker: the thread that renders.
        views: names and views to choose from.
        photographs: the same as cameras to draw.
        start: number of the view at which a browser starts.
        longest: most pixels along a picture's longest side, at the start.
    """

    painter: Painter
    worker: Worker
    views: Sequence[tuple[str, View]]
    photographs: Photographs
    start: int
    longest: int


class Session:
    """What happens in one browser. Called by viser's event loop, except where a method says that the rendering thread does."""

    def __init__(self, client: ClientHandle, stage: Stage) -> None:
        self._client, self._stage = client, stage
        names = [name for name, _ in stage.views]
        answers = Answers(self._ask_again, self._go, self._draw, self._save)
        self._controls = Controls(client.gui, stage.painter.subjects, names, stage.longest, answers)
        self._standing: int | None = None
        self._arrived, self._deadline = False, 0.0
        self._asked: tuple[int | None, float] | None = None
        self._frusta: dict[int, Any] = {}
        self._splats: Any = None
        self._gone = False
        self._why = ""
        self._painted: Painted | None = None
        client.camera.on_update(self._moved)
        self.stand(stage.start)

    def end(self) -> None:
        """The browser has gone."""
        self._gone = True
        for what in ("picture", "drawn"):
            self._stage.worker.forget((what, self._client.client_id))

    def stand(self, index: int) -> None:
        """Go to where a photograph was taken."""
        name, view = self._stage.views[index]
        self._standing, self._arrived, self._deadline = index, False, time.monotonic() + ARRIVAL
        self._controls.view.value = name
        pose, camera = view.camera.cam_to_world, self._client.camera
        position, forward = pose[:3, 3].double(), pose[:3, 2].double()
        reach = float((self._scene.bounds.centre.double() - position) @ forward)
        turning = position + forward * (reach if reach > 0 else self._scene.bounds.radius)
        with self._client.atomic():
            camera.position = position.numpy()
            camera.wxyz = np.array(quaternion(pose))
            camera.look_at = turning.numpy()
            camera.fov = self._mount().fov
        self._submit("drawn", self._drawing())
        self._controls.say(RENDERING)
        self._ask()

    def renew(self) -> None:
        """Show a model that has changed; called by the rendering thread."""
        self._controls.tell_facts()
        if self._splats is not None:
            self._splats.remove()
            self._splats = None
        self._submit("drawn", self._drawing())
        self._ask(resting=True)

    def complain(self, sentence: str) -> None:
        """Show what went wrong; called by the rendering thread."""
        if not self._gone:
            self._client.add_notification("The picture could not be made", sentence, color="red")

    @property
    def _scene(self) -> Scene:
        return self._stage.painter.subjects[0].scene

    @property
    def _gaze(self) -> Gaze:
        camera = self._client.camera
        return Gaze.of(tuple(camera.wxyz), tuple(camera.position), camera.fov, camera.aspect)

    @property
    def _window(self) -> tuple[int, int]:
        return self._client.camera.image_width, self._client.camera.image_height

    @property
    def _mounted(self) -> tuple[int | None, float]:
        """What the picture of a photograph's camera depends on: which one it is, and the window's shape."""
        return self._standing, round(self._client.camera.aspect, 2)

    def _mount(self) -> Mount:
        """How the photograph at which the browser stands lies in its window."""
        assert self._standing is not None
        photograph = self._stage.views[self._standing][1].camera
        return Mount.of(limited(photograph, int(self._controls.longest.value)), self._client.camera.aspect)

    async def _moved(self, _: CameraHandle) -> None:
        if self._standing is not None:
            pose = self._stage.views[self._standing][1].camera.cam_to_world
            there = self._gaze.sees_from(pose, NEAR_ENOUGH * self._scene.extent, NEAR_ENOUGH)
            self._arrived = self._arrived or there
            if not there and (self._arrived or time.monotonic() > self._deadline):
                self._standing, self._why = None, ""
                self._controls.view.value = ANYWHERE
                self._submit("drawn", self._drawing())
            elif self._asked == self._mounted:
                return  # the same picture
            else:
                self._client.camera.fov = self._mount().fov
        self._ask()

    async def _go(self) -> None:
        name, self._why = self._controls.view.value, ""
        if name != ANYWHERE:
            self.stand([each for each, _ in self._stage.views].index(name))
            return
        self._standing = None
        self._submit("drawn", self._drawing())
        self._ask()

    async def _ask_again(self) -> None:
        if self._controls.shown.value in OF_VIEWS and self._standing is None:
            index = nearest([view for _, view in self._stage.views], self._gaze, self._scene.extent)
            self._why = jump_words(self._controls.shown.value, self._stage.views[index][0])
            self.stand(index)
        else:
            self._submit("drawn", self._drawing())
            self._controls.say(RENDERING)
            self._ask()

    async def _draw(self) -> None:
        self._submit("drawn", self._drawing())
        self._controls.say(RENDERING)
        self._ask()

    async def _save(self) -> None:
        """Send the picture as a file."""
        if self._painted is None:
            return
        content = io.BytesIO()
        Image.fromarray(self._painted.picture).save(content, format="PNG")
        self._client.send_file_download(
            f"{self._scene.name}-{self._controls.shown.value}.png", content.getvalue(), save_immediately=True
        )

    def _submit(self, what: str, job: Job) -> None:
        self._stage.worker.submit((what, self._client.client_id), job)

    def _ask(self, resting: bool = False) -> None:
        """Order a picture of what is to be seen now."""
        controls, standing = self._controls, self._standing
        self._asked = self._mounted
        if controls.splats.value:
            self._submit("picture", self._backdrop())
            return
        shown = controls.shown.value
        order = Order(
            gaze=self._gaze,
            window=self._window,
            shown="prediction" if standing is None and shown in OF_VIEWS else shown,
            view=None if standing is None else self._stage.views[standing][1],
            layout=controls.layout.value,
            share=float(controls.share.value),
            longest=int(controls.longest.value),
            resting=resting,
            background=BACKGROUNDS[controls.background.value],
        )
        note = self._why if order.shown == shown else f"This is the prediction: the {shown} is known at photographs only."

        def deliver(painted: Painted) -> None:
            if self._gone:
                return
            self._painted = painted
            self._client.scene.set_background_image(painted.picture, format="png" if painted.finest else "jpeg")
            controls.tell(painted, note)

        self._submit("picture", self._stage.painter.paint(order, deliver))

    def _backdrop(self) -> Job:
        """Nothing but the scene's background, before which the browser draws."""
        plain = display(self._scene.background.expand(2, 2, 3), self._scene)
        self._client.scene.set_background_image(plain.numpy(), format="png")
        self._controls.say("Drawn by the browser: colours without view dependence.")
        yield 0.0

    def _drawing(self) -> Iterator[float]:
        """Make what the browser draws fit the controls, piece by piece, in the rendering thread."""
        if self._controls.splats.value and self._splats is None:
            self._splats = draw_splats(self._stage.painter.subjects[0], self._client.scene)
        if self._splats is not None:
            self._splats.visible = self._controls.splats.value
        for index in range(len(self._stage.photographs)):
            wanted = self._controls.cameras.value and index != self._standing and self._controls.layout.value != "side by side"
            if index not in self._frusta and wanted:
                self._frusta[index] = self._stage.photographs.draw(index, self._client.scene, self._chooser(index))
                yield 0.0
            elif index in self._frusta and self._frusta[index].visible != wanted:
                self._frusta[index].visible = wanted

    def _chooser(self, index: int) -> Any:
        async def choose() -> None:
            self.stand(index)

        return choose


def jump_words(shown: str, view: str) -> str:
    """Why choosing to see something has moved the camera."""
    return f"Moved to the nearest photograph, {view}: the {shown} is known at photographs only."


def nearest(views: Sequence[View], gaze: Gaze, extent: float) -> int:
    """Number of the view whose camera is most like a browser's: distance in scene extents and angle in radians, added."""
    poses = torch.stack([view.camera.cam_to_world for view in views])
    distance = (poses[:, :3, 3] - gaze.pose[:3, 3]).norm(dim=1) / extent
    angle = (poses[:, :3, 2] @ gaze.pose[:3, 2]).clamp(-1, 1).acos()
    return int((distance + angle).argmin())
