"""Session of one browser: camera, control panel and overlays; requests frames when they change."""

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
from invgraphics.viewer.cameras import LetterboxedView, ViewerCamera, limit_size, rotation_quaternion
from invgraphics.viewer.colorize import NEEDS_TRUTH
from invgraphics.viewer.controls import BACKGROUNDS, FREE_CAMERA, Callbacks, Controls
from invgraphics.viewer.overlays import CameraFrustums, add_splats
from invgraphics.viewer.progressive import Frame, ProgressiveRenderer, RenderRequest
from invgraphics.viewer.render_thread import RenderThread, Task

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

NEAR_ENOUGH = 1e-3
"""How far from a photograph's camera a browser may be to count as at it: radians, and of the scene's extent."""
ARRIVAL = 10.0
"""Seconds that a browser has to reach a photograph it was sent to."""

RENDERING = "Rendering …"
"""Status until the first frame after a change."""


@dataclass(frozen=True, eq=False)
class SharedState:
    """State shared by all sessions.

    Attributes:
        renderer: of the runs.
        thread: runs render tasks.
        views: names and views to choose from.
        frustums: overlays of the same views.
        start: index of the initial view.
        max_size: initial limit of the longer side, pixels.
    """

    renderer: ProgressiveRenderer
    thread: RenderThread
    views: Sequence[tuple[str, View]]
    frustums: CameraFrustums
    start: int
    max_size: int


class Session:
    """Session of one browser. Methods run in viser's event loop, except where the render thread is named."""

    def __init__(self, client: ClientHandle, shared: SharedState) -> None:
        self._client, self._shared = client, shared
        names = [name for name, _ in shared.views]
        callbacks = Callbacks(self._output_changed, self._view_chosen, self._overlays_changed, self._save_image)
        self._controls = Controls(client.gui, shared.renderer.runs, names, shared.max_size, callbacks)
        self._view_index: int | None = None
        self._arrived, self._deadline = False, 0.0
        self._requested: tuple[int | None, float] | None = None
        self._frustums: dict[int, Any] = {}
        self._splats: Any = None
        self._closed = False
        self._notice = ""
        self._frame: Frame | None = None
        client.camera.on_update(self._camera_changed)
        self.go_to_view(shared.start)

    def close(self) -> None:
        """Cancel the tasks of a browser that has disconnected."""
        self._closed = True
        for what in ("frame", "overlays"):
            self._shared.thread.cancel((what, self._client.client_id))

    def go_to_view(self, index: int) -> None:
        """Move the camera to a photograph's."""
        name, view = self._shared.views[index]
        self._view_index, self._arrived, self._deadline = index, False, time.monotonic() + ARRIVAL
        self._controls.view.value = name
        pose, camera = view.camera.cam_to_world, self._client.camera
        position, forward = pose[:3, 3].double(), pose[:3, 2].double()
        reach = float((self._scene.bounds.centre.double() - position) @ forward)
        turning = position + forward * (reach if reach > 0 else self._scene.bounds.radius)
        with self._client.atomic():
            camera.position = position.numpy()
            camera.wxyz = np.array(rotation_quaternion(pose))
            camera.look_at = turning.numpy()
            camera.fov = self._letterbox().fov
        self._submit("overlays", self._update_overlays())
        self._controls.show_status(RENDERING)
        self._request_frame()

    def refresh(self) -> None:
        """Show a reloaded model; called by the render thread."""
        self._controls.update_summary()
        if self._splats is not None:
            self._splats.remove()
            self._splats = None
        self._submit("overlays", self._update_overlays())
        self._request_frame(skip_coarse=True)

    def show_error(self, sentence: str) -> None:
        """Show an error as a notification; called by the render thread."""
        if not self._closed:
            self._client.add_notification("The picture could not be made", sentence, color="red")

    @property
    def _scene(self) -> Scene:
        return self._shared.renderer.runs[0].scene

    @property
    def _camera(self) -> ViewerCamera:
        camera = self._client.camera
        return ViewerCamera.from_viser(tuple(camera.wxyz), tuple(camera.position), camera.fov, camera.aspect)

    @property
    def _window(self) -> tuple[int, int]:
        return self._client.camera.image_width, self._client.camera.image_height

    @property
    def _letterboxed(self) -> tuple[int | None, float]:
        """What the image at a photograph depends on: its index and the window's aspect."""
        return self._view_index, round(self._client.camera.aspect, 2)

    def _letterbox(self) -> LetterboxedView:
        """The current photograph letterboxed into the window."""
        assert self._view_index is not None
        photograph = self._shared.views[self._view_index][1].camera
        return LetterboxedView.fit(limit_size(photograph, int(self._controls.max_size.value)), self._client.camera.aspect)

    async def _camera_changed(self, _: CameraHandle) -> None:
        if self._view_index is not None:
            pose = self._shared.views[self._view_index][1].camera.cam_to_world
            there = self._camera.is_at(pose, NEAR_ENOUGH * self._scene.extent, NEAR_ENOUGH)
            self._arrived = self._arrived or there
            if not there and (self._arrived or time.monotonic() > self._deadline):
                self._view_index, self._notice = None, ""
                self._controls.view.value = FREE_CAMERA
                self._submit("overlays", self._update_overlays())
            elif self._requested == self._letterboxed:
                return  # unchanged
            else:
                self._client.camera.fov = self._letterbox().fov
        self._request_frame()

    async def _view_chosen(self) -> None:
        name, self._notice = self._controls.view.value, ""
        if name != FREE_CAMERA:
            self.go_to_view([each for each, _ in self._shared.views].index(name))
            return
        self._view_index = None
        self._submit("overlays", self._update_overlays())
        self._request_frame()

    async def _output_changed(self) -> None:
        if self._controls.output.value in NEEDS_TRUTH and self._view_index is None:
            index = nearest_view([view for _, view in self._shared.views], self._camera, self._scene.extent)
            self._notice = jump_notice(self._controls.output.value, self._shared.views[index][0])
            self.go_to_view(index)
        else:
            self._submit("overlays", self._update_overlays())
            self._controls.show_status(RENDERING)
            self._request_frame()

    async def _overlays_changed(self) -> None:
        self._submit("overlays", self._update_overlays())
        self._controls.show_status(RENDERING)
        self._request_frame()

    async def _save_image(self) -> None:
        """Send the current image as a PNG file."""
        if self._frame is None:
            return
        content = io.BytesIO()
        Image.fromarray(self._frame.image).save(content, format="PNG")
        self._client.send_file_download(
            f"{self._scene.name}-{self._controls.output.value}.png", content.getvalue(), save_immediately=True
        )

    def _submit(self, what: str, task: Task) -> None:
        self._shared.thread.submit((what, self._client.client_id), task)

    def _request_frame(self, skip_coarse: bool = False) -> None:
        """Submit a render request for the current camera and controls."""
        controls, view_index = self._controls, self._view_index
        self._requested = self._letterboxed
        if controls.splats.value:
            self._submit("frame", self._clear_background())
            return
        output = controls.output.value
        request = RenderRequest(
            camera=self._camera,
            window=self._window,
            output="prediction" if view_index is None and output in NEEDS_TRUTH else output,
            view=None if view_index is None else self._shared.views[view_index][1],
            layout=controls.layout.value,
            split=float(controls.split.value),
            max_size=int(controls.max_size.value),
            skip_coarse=skip_coarse,
            background=BACKGROUNDS[controls.background.value],
        )
        note = (
            self._notice if request.output == output else f"This is the prediction: the {output} is known at photographs only."
        )

        def on_frame(frame: Frame) -> None:
            if self._closed:
                return
            self._frame = frame
            self._client.scene.set_background_image(frame.image, format="png" if frame.final else "jpeg")
            controls.show_frame(frame, note)

        self._submit("frame", self._shared.renderer.render(request, on_frame))

    def _clear_background(self) -> Task:
        """Clear the image to the scene's background, behind splats drawn by the browser."""
        plain = display(self._scene.background.expand(2, 2, 3), self._scene)
        self._client.scene.set_background_image(plain.numpy(), format="png")
        self._controls.show_status("Drawn by the browser: colours without view dependence.")
        yield 0.0

    def _update_overlays(self) -> Iterator[float]:
        """Bring the overlays in line with the controls; runs in the render thread."""
        if self._controls.splats.value and self._splats is None:
            self._splats = add_splats(self._shared.renderer.runs[0], self._client.scene)
        if self._splats is not None:
            self._splats.visible = self._controls.splats.value
        for index in range(len(self._shared.frustums)):
            wanted = (
                self._controls.cameras.value and index != self._view_index and self._controls.layout.value != "side by side"
            )
            if index not in self._frustums and wanted:
                self._frustums[index] = self._shared.frustums.add(index, self._client.scene, self._view_callback(index))
                yield 0.0
            elif index in self._frustums and self._frustums[index].visible != wanted:
                self._frustums[index].visible = wanted

    def _view_callback(self, index: int) -> Any:
        async def choose() -> None:
            self.go_to_view(index)

        return choose


def jump_notice(output: str, view: str) -> str:
    """The reason why choosing an output has moved the camera."""
    return f"Moved to the nearest photograph, {view}: the {output} is known at photographs only."


def nearest_view(views: Sequence[View], viewer_camera: ViewerCamera, extent: float) -> int:
    """Index of the view nearest to a camera: distance in scene extents plus angle in radians."""
    poses = torch.stack([view.camera.cam_to_world for view in views])
    distance = (poses[:, :3, 3] - viewer_camera.pose[:3, 3]).norm(dim=1) / extent
    angle = (poses[:, :3, 2] @ viewer_camera.pose[:3, 2]).clamp(-1, 1).acos()
    return int((distance + angle).argmin())
