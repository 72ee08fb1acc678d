"""Moves of a browser's camera: sending one, and telling late reports from a camera that its user has moved away."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.viewer.cameras import ViewerCamera, rotation_quaternion

if TYPE_CHECKING:
    from viser import ClientHandle

NEAR_ENOUGH = 1e-3
"""How far from a photograph's camera a browser may be to count as at it: radians, and of the scene's extent."""
ARRIVAL = 10.0
"""Seconds for which whatever a browser reports on its way to a photograph is ignored."""


@dataclass
class CameraMove:
    """A camera sent to ``destination`` at time ``start`` (seconds), from ``departure``.

    A busy browser goes on reporting its old camera until it gets the new one, so that before arrival a report from the place
    of departure never counts as leaving; one from anywhere else does once `ARRIVAL` has passed.

    Attributes:
        departure: camera-to-world where the browser was, in the scene's local frame.
        destination: camera-to-world of the photograph.
        extent: of the scene, in local units.
        start: when the camera was sent, in seconds of the clock that `has_left` is given.
    """

    departure: Float[Tensor, "4 4"]
    destination: Float[Tensor, "4 4"]
    extent: float
    start: float
    _arrived: bool = field(default=False, init=False)

    def has_left(self, camera: ViewerCamera, now: float) -> bool:
        """Whether the reported camera was moved away from the photograph, or elsewhere before it got there."""
        if self._is_at(camera, self.destination):
            self._arrived = True
            return False
        if self._arrived:
            return True
        return now > self.start + ARRIVAL and not self._is_at(camera, self.departure)

    def _is_at(self, camera: ViewerCamera, pose: Float[Tensor, "4 4"]) -> bool:
        return camera.is_at(pose, NEAR_ENOUGH * self.extent, NEAR_ENOUGH)


def send_camera(
    client: ClientHandle, pose: Float[Tensor, "4 4"], fov: float, scene: Scene, up: tuple[float, float, float]
) -> float:
    """Send a browser a camera; it turns around the point ahead that is nearest to the scene's centre.

    Args:
        client: the browser.
        pose: camera-to-world in the scene's local frame.
        fov: vertical field of view, radians.
        scene: of the first run.
        up: of the orbit controls, in the local frame.

    Returns:
        Viser's time stamp of the camera.
    """
    camera, position, forward = client.camera, pose[:3, 3].double(), pose[:3, 2].double()
    reach = float((scene.bounds.centre.double() - position) @ forward)
    turning = position + forward * (reach if reach > 0 else scene.bounds.radius)
    with client.atomic():
        camera.position = position.numpy()
        # Viser tilts the up direction that it has to fit the pose: without the scene's own, tilts would add up.
        camera.up_direction = up
        camera.wxyz = np.array(rotation_quaternion(pose))
        camera.look_at = turning.numpy()
        camera.fov = fov
    return camera.update_timestamp
