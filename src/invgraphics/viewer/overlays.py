"""Overlays drawn by the browser: camera frustums and Gaussian splats."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from invgraphics.core import Gaussians, Quantity, Scene
from invgraphics.core.colour import linear_to_srgb
from invgraphics.core.harmonics import BAND_0
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.experiments.evaluate import display
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.tools.colorize import Picture, true_image
from invgraphics.viewer.cameras import fov_and_aspect, rotation_quaternion
from invgraphics.viewer.loaded_run import LoadedRun

THUMBNAIL = 96
"""Pixels along the longer side of a frustum's photograph."""
FRUSTUM_SIZE = 0.04
"""Size of a frustum, of the scene's extent; viser takes a third of its sides' product as the size cubed."""
TEST_COLOUR, TRAIN_COLOUR = (213, 94, 0), (0, 114, 178)
LARGEST_HALF = 3e4
"""Largest variance that is sent; the browser keeps half floats, at most 65504."""


class CameraFrustums:
    """Camera frustums of a scene's photographs, with thumbnails that are made on first use.

    Args:
        run: whose views they are.
    """

    def __init__(self, run: LoadedRun) -> None:
        self._run = run
        self._thumbnails: dict[int, Picture] = {}

    def __len__(self) -> int:
        return len(self._run.views())

    def add(self, index: int, viser_scene: Any, on_click: Callable[[], Any]) -> Any:
        """Add one frustum to a viser scene; returns its handle. ``on_click`` is awaited when it is clicked."""
        name, view = self._run.views()[index]
        fov, aspect = fov_and_aspect(view.camera)
        handle = viser_scene.add_camera_frustum(
            f"/cameras/{index}",
            fov,
            aspect,
            scale=FRUSTUM_SIZE * self._run.scene.extent,
            thickness=1.5,
            thickness_units="screen",
            color=TEST_COLOUR if name.startswith("test") else TRAIN_COLOUR,
            image=self._thumbnail(index),
            wxyz=rotation_quaternion(view.camera.cam_to_world),
            position=tuple(view.camera.position.tolist()),
        )

        async def clicked(_: Any) -> None:
            await on_click()

        handle.on_click(clicked)
        return handle

    def _thumbnail(self, index: int) -> Picture:
        if index not in self._thumbnails:
            view = self._run.views()[index][1]
            height, width = view.image.shape[:2]
            scale = min(1.0, THUMBNAIL / max(width, height))
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            self._thumbnails[index] = true_image(view, self._run.scene, size)
        return self._thumbnails[index]


class Overlays:
    """Frustums and splats in one browser, added when they are first shown.

    Args:
        viser_scene: of the browser.
        run: whose local frame they are in.
        frustums: of its views.
        on_click: awaited with the index of a frustum that is clicked.
    """

    def __init__(
        self, viser_scene: Any, run: LoadedRun, frustums: CameraFrustums, on_click: Callable[[int], Awaitable[None]]
    ) -> None:
        self._viser_scene, self._run, self._views, self._on_click = viser_scene, run, frustums, on_click
        self._frustums: dict[int, Any] = {}
        self._splats: dict[LoadedRun, Any] = {}
        self._shown = run.scene

    def update(self, splats: LoadedRun | None, frustums: bool, hidden: int | None) -> Iterator[float]:
        """Show the splats of one run or none, and frustums except that of the view ``hidden``; a task of the render thread."""
        if splats is not None and splats not in self._splats:
            name = f"/splats-{len(self._splats)}"
            self._splats[splats] = add_splats(splats, self._viser_scene, name, self._run.scene)
        for run, handle in self._splats.items():
            handle.visible = run is splats
        for index in range(len(self._views)):
            wanted = frustums and index != hidden
            if index not in self._frustums and wanted:
                self._frustums[index] = self._views.add(index, self._viser_scene, partial(self._on_click, index))
                yield 0.0
            elif index in self._frustums and self._frustums[index].visible != wanted:
                self._frustums[index].visible = wanted

    def remove_outdated(self) -> bool:
        """Remove the splats, whose model has changed, and frustums that have moved; `update` adds the new ones.

        Returns:
            Whether cameras have moved, as those of a fit that refines their poses.
        """
        for handle in self._splats.values():
            handle.remove()
        self._splats.clear()
        moved, self._shown = self._shown is not self._run.scene, self._run.scene
        if moved:
            for handle in self._frustums.values():
                handle.remove()
            self._frustums.clear()
        return moved


def plain_background(scene: Scene, colour: tuple[float, float, float] | None) -> Picture:
    """A picture of one colour, in the scene's colour space; ``None`` is the scene's own."""
    chosen = scene.background if colour is None else torch.tensor(colour)
    return display(chosen.expand(2, 2, 3), scene).numpy()


def add_splats(run: LoadedRun, viser_scene: Any, name: str, scene: Scene) -> Any:
    """Add a run's Gaussians, coloured by spherical-harmonics band 0, to a viser scene in ``scene``'s local frame.

    Returns:
        Their handle.
    """
    ctx = run.fitted.model.context()
    with torch.no_grad():
        gaussians: Gaussians = run.fitted.model.field.primitives(Quantity.GAUSSIANS, ctx)
        rgb = (0.5 + BAND_0 * gaussians.sh[:, 0]).clamp(0, 1)
        rgb = linear_to_srgb(rgb) if run.scene.colour == "linear" else rgb
        if run.scene is not scene:
            gaussians = transform_gaussians(gaussians, torch.linalg.inv(run.from_local(scene)).to(gaussians.means))
        unit = half_precision_scale(gaussians)
        centres, covariances = _moments(gaussians)
    return viser_scene.add_gaussian_splats(
        name,
        centers=(centres * unit).astype(np.float32),
        covariances=(covariances * unit**2).astype(np.float32),
        rgbs=rgb.cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy()[:, None],
        scale=1 / unit,
    )


def half_precision_scale(gaussians: Gaussians) -> float:
    """Scale factor that maps the largest variance to `LARGEST_HALF`."""
    return math.sqrt(LARGEST_HALF) / max(float(gaussians.scales.max()), 1e-12)


def _moments(gaussians: Gaussians) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3 3"]]:
    """Means and covariances in double precision."""
    axes = quaternion_to_matrix(gaussians.quaternions.double()) * gaussians.scales.double()[:, None, :]
    return gaussians.means.double().cpu().numpy(), (axes @ axes.transpose(1, 2)).cpu().numpy()
