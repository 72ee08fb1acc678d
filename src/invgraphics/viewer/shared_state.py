"""State shared by the sessions of all browsers."""

from __future__ import annotations

from dataclasses import dataclass, field

from invgraphics.core import View
from invgraphics.tools.camera_path import CameraPath
from invgraphics.viewer.overlays import CameraFrustums
from invgraphics.viewer.progressive import ProgressiveRenderer
from invgraphics.viewer.render_thread import RenderThread


@dataclass(eq=False)
class SharedState:
    """State shared by all sessions.

    Attributes:
        renderer: of the runs.
        thread: runs render tasks.
        frustums: overlays of `views`.
        start: index of the initial view.
        max_size: initial limit of the longer side, pixels.
        up: up direction of the orbit controls, in the first run's local frame.
        path: the camera path that was changed last, by any browser; one that connects, or connects again, begins with it.
    """

    renderer: ProgressiveRenderer
    thread: RenderThread
    frustums: CameraFrustums
    start: int
    max_size: int
    up: tuple[float, float, float]
    path: CameraPath = field(default_factory=lambda: CameraPath(()))

    @property
    def views(self) -> list[tuple[str, View]]:
        """Names and views to choose from; their cameras change with the checkpoint where poses are refined."""
        return self.renderer.runs[0].views()
