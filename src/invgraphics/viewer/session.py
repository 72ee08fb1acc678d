"""Session of one browser: camera, control panel and overlays; requests frames when they change."""

from __future__ import annotations

import asyncio
import io
import math
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.tools.camera_path import CameraPath, Keyframe
from invgraphics.tools.colorize import NEEDS_TRUTH
from invgraphics.viewer.camera_move import CameraMove, send_camera
from invgraphics.viewer.cameras import LetterboxedView, ViewerCamera, fov_and_aspect, limit_size, nearest_view_index
from invgraphics.viewer.controls import BACKGROUNDS, FREE_CAMERA, Callbacks, Controls, jump_notice, on_change
from invgraphics.viewer.crop import crop_note
from invgraphics.viewer.crop_panel import CropPanel
from invgraphics.viewer.film_export import FilmLook, export_film, film_size
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.overlays import Overlays, plain_background
from invgraphics.viewer.path_panel import PathCallbacks, PathPanel
from invgraphics.viewer.progressive import RenderRequest, ViewerFrame
from invgraphics.viewer.render_thread import Task
from invgraphics.viewer.shared_state import SharedState

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

RENDERING = "Rendering …"
"""Status until the first frame after a change."""


class Session:
    """Session of one browser. Methods run in viser's event loop, except where the render thread is named."""

    def __init__(self, client: ClientHandle, shared: SharedState) -> None:
        self._client, self._shared = client, shared
        names = [name for name, _ in shared.views]
        callbacks = Callbacks(
            self._output_changed, self._view_chosen, self._overlays_changed, self._save_image, self._fov_changed
        )
        self._controls = Controls(client.gui, shared.renderer.runs, names, shared.max_size, callbacks)
        self._crop = CropPanel(client.gui, client.scene, lambda: self._scene)
        for handle in (self._crop.enabled, *self._crop.axes):
            on_change(handle, self._crop_changed)
        path = PathCallbacks(self._keyframe, self._move_to, self._export, self._stop_export, self._download, self._keep)
        self._path = PathPanel(client.gui, client.scene, lambda: self._scene, shared.path, path)
        self._view_index: int | None = None
        self._move: CameraMove | None = None
        self._requested: tuple[int | None, float] | None = None
        self._sent_at = 0.0
        self._overlays = Overlays(client.scene, shared.renderer.runs[0], shared.frustums, self._frustum_clicked)
        self._closed = False
        self._notice = ""
        self._frame: ViewerFrame | None = None
        self._latest: RenderRequest | None = None
        self._finished: RenderRequest | None = None
        self._loop = asyncio.get_running_loop()
        client.camera.on_update(self._camera_changed)
        self.go_to_view(shared.start)

    def close(self) -> None:
        """Cancel the tasks of a browser that has disconnected."""
        self._closed = True
        self._path.close()
        for what in ("frame", "overlays", "film"):
            self._shared.thread.cancel((what, self._client.client_id))

    def go_to_view(self, index: int) -> None:
        """Move the camera to a photograph's."""
        name, view = self._shared.views[index]
        self._view_index = index
        self._move = CameraMove(self._camera.pose, view.camera.cam_to_world, self._scene.extent, time.monotonic())
        self._controls.view.value = name
        self._set_camera(view.camera.cam_to_world, self._letterbox().fov)
        self._submit("overlays", self._update_overlays())
        self._controls.show_status(RENDERING)
        self._request_frame()

    def _set_camera(self, pose: Float[Tensor, "4 4"], fov: float) -> None:
        self._sent_at = send_camera(self._client, pose, fov, self._scene, self._shared.up)
        self._controls.show_fov(fov)

    def show_held(self) -> None:
        """Say that a newer checkpoint waits; called by the render thread."""
        self._controls.update_summary("A newer checkpoint is shown when the film that is being exported is finished.")

    def refresh(self) -> None:
        """Show a reloaded model; called by the render thread."""
        self._controls.update_summary()
        moved = self._overlays.remove_outdated()
        self._loop.call_soon_threadsafe(self._show_reloaded, moved)  # there reports of cameras arrive

    def _show_reloaded(self, moved: bool) -> None:
        """Request what the reloaded model shows; at a photograph from its new place if the frame's cameras have ``moved``."""
        if self._closed:
            return
        if moved:
            self._crop.draw()
            self._path.draw()
        if moved and self._view_index is not None:
            self.go_to_view(self._view_index)
            return
        self._submit("overlays", self._update_overlays())
        self._request_frame(skip_coarse=self._finished is self._latest)

    def show_error(self, task: str, sentence: str) -> None:
        """Show the error of a task, "film" or another, as a notification; called by the render thread."""
        if self._closed:
            return
        if task == "film":
            self._path.show_status("The film could not be made.", exporting=False)
        elif task == "frame":
            self._controls.show_status(f"The picture could not be made: {sentence}")
        title = "The film could not be made" if task == "film" else "The picture could not be made"
        self._client.add_notification(title, sentence, color="red")

    @property
    def _runs(self) -> tuple[LoadedRun, ...]:
        return self._shared.renderer.runs

    @property
    def _scene(self) -> Scene:
        return self._runs[0].scene

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

    async def _camera_changed(self, camera: CameraHandle) -> None:
        # The report that connects a browser gets here after the first photograph's camera has taken its place.
        if camera.update_timestamp == self._sent_at:
            return
        if self._view_index is not None:
            if self._move is not None and self._move.has_left(self._camera, time.monotonic()):
                self._leave_photograph()
            elif self._requested == self._letterboxed:
                return  # unchanged
            else:
                self._client.camera.fov = self._letterbox().fov
                self._controls.show_fov(self._client.camera.fov)
        self._request_frame()

    def _leave_photograph(self) -> None:
        """Free the camera; at a photograph, its frustum is shown again."""
        if self._view_index is not None:
            self._view_index = None
            self._submit("overlays", self._update_overlays())
        self._notice, self._controls.view.value = "", FREE_CAMERA

    async def _fov_changed(self) -> None:
        self._leave_photograph()
        self._client.camera.fov = math.radians(float(self._controls.fov.value))
        self._request_frame()

    async def _view_chosen(self) -> None:
        name, self._notice = self._controls.view.value, ""
        if name == FREE_CAMERA:
            self._leave_photograph()
            self._request_frame()
        else:
            self.go_to_view([each for each, _ in self._shared.views].index(name))

    async def _output_changed(self) -> None:
        self._crop.show_outline(self._controls.one_camera)
        self._path.show_line(self._controls.one_camera)
        if self._controls.output.value in NEEDS_TRUTH and self._view_index is None:
            index = nearest_view_index([view for _, view in self._shared.views], self._camera, self._scene.extent)
            self._notice = jump_notice(self._controls.output.value, self._shared.views[index][0])
            self.go_to_view(index)
        else:
            await self._overlays_changed()

    async def _overlays_changed(self) -> None:
        self._submit("overlays", self._update_overlays())
        self._controls.show_status(RENDERING)
        self._request_frame()

    async def _save_image(self) -> None:
        """Send the current image as a PNG file."""
        if self._frame is None:
            self._controls.show_status("Nothing to save: splats are drawn by the browser. Switch that off first.")
            return
        content = io.BytesIO()
        Image.fromarray(self._frame.picture).save(content, format="PNG")
        self._download(f"{self._scene.name}-{self._frame.output}.png", content.getvalue())

    def _download(self, name: str, content: bytes) -> None:
        self._client.send_file_download(name, content, save_immediately=True)

    async def _crop_changed(self) -> None:
        self._crop.draw()
        self._request_frame()

    def _keyframe(self) -> Keyframe:
        """The current camera; at a photograph with the photograph's field of view, not the window's."""
        fov = self._camera.fov
        if self._view_index is not None:
            fov = fov_and_aspect(self._shared.views[self._view_index][1].camera)[0]
        return Keyframe.from_local(self._camera.pose, fov, self._scene)

    def _move_to(self, keyframe: Keyframe) -> None:
        """Move the camera to a keyframe."""
        self._leave_photograph()
        self._set_camera(keyframe.local_pose(self._scene), keyframe.fov)

    def _export(self, path: CameraPath) -> None:
        """Render a film of the path in the render thread and send it to the browser."""
        run = self._runs[-1 if self._controls.layout.value == "second" else 0]
        box = self._crop.box
        box = None if box is None else run.crop_to_local(box, self._scene)
        background, rate = BACKGROUNDS[self._controls.background.value], int(self._path.rate.value)
        look = FilmLook(self._controls.free_output, background, box, rate)
        size = film_size(self._path.shape.value, run, self._window, int(self._controls.max_size.value))
        cameras = path.cameras(run.scene, path.frame_count(rate), size)
        self._submit("film", export_film(run, cameras, look, self._show_film_progress, self._send_film))

    def _show_film_progress(self, line: str) -> None:
        if not self._closed:
            self._path.show_status(line)

    def _send_film(self, content: bytes, line: str) -> None:
        if not self._closed:
            self._download(f"{self._scene.name}-path.mp4", content)
            self._path.show_status(line, exporting=False)

    def _keep(self, path: CameraPath) -> None:
        self._shared.path = path

    def _stop_export(self) -> None:
        self._shared.thread.cancel(("film", self._client.client_id))

    def _submit(self, what: str, task: Task) -> None:
        self._shared.thread.submit((what, self._client.client_id), task)

    def _request_frame(self, skip_coarse: bool = False) -> None:
        """Submit a render request for the current camera and controls."""
        controls, view_index = self._controls, self._view_index
        self._requested = self._letterboxed
        if controls.splat_run is not None:
            self._submit("frame", self._clear_background(controls.splat_run))
            return
        output = controls.output.value
        view = None if view_index is None else self._shared.views[view_index][1]
        request = self._latest = controls.request(self._camera, self._window, view, self._crop.box, skip_coarse)
        note = (
            self._notice if request.output == output else f"This is the prediction: the {output} is known at photographs only."
        )
        if request.crop is not None:
            runs = {"first": self._runs[:1], "second": self._runs[-1:]}.get(request.layout, self._runs)
            note = " ".join(filter(None, (note, *dict.fromkeys(crop_note(run.fitted.model.renderer) for run in runs))))

        def on_frame(frame: ViewerFrame) -> None:
            if self._closed:
                return
            self._frame = frame
            self._finished = request if frame.final else self._finished
            self._client.scene.set_background_image(frame.image, format="png" if frame.final else "jpeg")
            controls.show_frame(frame, note)

        self._submit("frame", self._shared.renderer.render(request, on_frame))

    def _clear_background(self, run: LoadedRun) -> Task:
        """Clear the image to the chosen background, behind a run's splats drawn by the browser."""
        self._frame = None
        plain = plain_background(self._scene, BACKGROUNDS[self._controls.background.value])
        self._client.scene.set_background_image(plain, format="png")
        self._controls.show_splat_status(run, self._crop.box is not None)
        yield 0.0

    def _update_overlays(self) -> Iterator[float]:
        """Bring the overlays in line with the controls; runs in the render thread."""
        controls = self._controls
        frustums = controls.cameras.value and controls.one_camera
        yield from self._overlays.update(controls.splat_run, frustums, self._view_index)

    async def _frustum_clicked(self, index: int) -> None:
        self.go_to_view(index)
