"""What the browser draws itself, over the picture: the photographs' cameras, and Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from invgraphics.core import Gaussians, Quantity, Scene, View
from invgraphics.core.colour import linear_to_srgb
from invgraphics.core.harmonics import BAND_0
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.viewer.cameras import frustum, quaternion
from invgraphics.viewer.colouring import Picture, photograph
from invgraphics.viewer.subject import Subject

THUMBNAIL = 96
"""Pixels along the longest side of a photograph in its camera."""
FRUSTUM_SIZE = 0.04
"""Size of a camera's pyramid, of the scene's extent; viser takes a third of its sides' product as the size cubed."""
TEST_COLOUR, TRAIN_COLOUR = (213, 94, 0), (0, 114, 178)
LARGEST_HALF = 3e4
"""Largest variance that is sent; half precision, in which the browser keeps them, ends at 65504."""


class Photographs:
    """The photographs of a scene as cameras with small pictures, which are made when they are first wanted.

    Args:
        views: names and views.
        scene: they belong to.
    """

    def __init__(self, views: Sequence[tuple[str, View]], scene: Scene) -> None:
        self._views, self._scene = views, scene
        self._thumbnails: dict[int, Picture] = {}

    def __len__(self) -> int:
        return len(self._views)

    def draw(self, index: int, into: Any, chosen: Callable[[], Any]) -> Any:
        """Add one camera to a browser's scene; returns its handle. ``chosen`` is called, and awaited, when it is clicked."""
        name, view = self._views[index]
        fov, aspect = frustum(view.camera)
        handle = into.add_camera_frustum(
            f"/cameras/{index}",
            fov,
            aspect,
            scale=FRUSTUM_SIZE * self._scene.extent,
            thickness=1.5,
            thickness_units="screen",
            color=TEST_COLOUR if name.startswith("test") else TRAIN_COLOUR,
            image=self._thumbnail(index),
            wxyz=quaternion(view.camera.cam_to_world),
            position=tuple(view.camera.position.tolist()),
        )

        async def clicked(_: Any) -> None:
            await chosen()

        handle.on_click(clicked)
        return handle

    def _thumbnail(self, index: int) -> Picture:
        if index not in self._thumbnails:
            view = self._views[index][1]
            height, width = view.image.shape[:2]
            scale = min(1.0, THUMBNAIL / max(width, height))
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            self._thumbnails[index] = photograph(view, self._scene, size)
        return self._thumbnails[index]


def draw_splats(subject: Subject, into: Any) -> Any:
    """Add a run's Gaussians to a browser's scene; returns their handle. Colours are those of band 0."""
    ctx = subject.fitted.model.context()
    with torch.no_grad():
        gaussians: Gaussians = subject.fitted.model.field.primitives(Quantity.GAUSSIANS, ctx)
        rgb = (0.5 + BAND_0 * gaussians.sh[:, 0]).clamp(0, 1)
        rgb = linear_to_srgb(rgb) if subject.scene.colour == "linear" else rgb
        unit = enlargement(gaussians)
        centres, covariances = _moments(gaussians)
    return into.add_gaussian_splats(
        "/splats",
        centers=(centres * unit).astype(np.float32),
        covariances=(covariances * unit**2).astype(np.float32),
        rgbs=rgb.cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy()[:, None],
        scale=1 / unit,
    )


def enlargement(gaussians: Gaussians) -> float:
    """The factor that makes the best of half precision: the largest Gaussian's variance is the largest number."""
    return math.sqrt(LARGEST_HALF) / max(float(gaussians.scales.max()), 1e-12)


def _moments(gaussians: Gaussians) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3 3"]]:
    """Means and covariances, in double precision."""
    axes = quaternion_to_matrix(gaussians.quaternions.double()) * gaussians.scales.double()[:, None, :]
    return gaussians.means.double().cpu().numpy(), (axes @ axes.transpose(1, 2)).cpu().numpy()
