"""Pictures of coloured dots from cameras written out in plain numpy: the independent truth of the loader tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from invgraphics.core import Scene, View

POINTS = np.array([[0, 0, 0], [0.8, 0.1, 0.3], [-0.7, 0.2, 0.4], [0.1, 0.7, -0.5], [-0.2, -0.8, 0.6], [0.3, -0.5, -0.6]], float)
COLOURS = np.array([[1, 1, 1], [1, 0.1, 0.1], [0.1, 1, 0.1], [0.1, 0.1, 1], [1, 1, 0.1], [0.1, 1, 1]], float)
SIGMA = 1.5  # of a dot, pixels
GL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes from OpenCV axes, as a matrix product from the right

Distortion = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Eye:
    """A camera: x' = K [R t] X, row vectors of R are right, down and forward."""

    R: np.ndarray
    t: np.ndarray
    focal: tuple[float, float] = (150.0, 155.0)
    centre: tuple[float, float] = (83.0, 58.0)
    size: tuple[int, int] = (160, 120)
    distortion: Distortion | None = None

    @property
    def cam_to_world(self) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.R.T, -self.R.T @ self.t
        return pose

    def pixels(self, points: np.ndarray) -> np.ndarray:
        x, y, z = (points @ self.R.T + self.t).T
        x, y = x / z, y / z
        if self.distortion is not None:
            x, y = self.distortion(x, y)
        return np.stack([self.focal[0] * x + self.centre[0], self.focal[1] * y + self.centre[1]], axis=1)

    def picture(self, with_alpha: bool = False) -> np.ndarray:
        """Dots on black, or dots that are opaque in their middle."""
        width, height = self.size
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        squared = ((grid[None] - self.pixels(POINTS)[:, None, None]) ** 2).sum(-1)
        weight = np.exp(-squared / (2 * SIGMA**2))
        if not with_alpha:
            return np.rint(255 * np.tensordot(weight, COLOURS, (0, 0)).clip(0, 1)).astype(np.uint8)
        colour = COLOURS[weight.argmax(0)]
        return np.rint(255 * np.concatenate([colour, weight.max(0)[..., None]], axis=-1)).astype(np.uint8)


def composited(rgba: np.ndarray, background: np.ndarray | float) -> np.ndarray:
    """Opaque 8-bit colours of a picture with straight alpha before a background of 0 to 255."""
    cover = rgba[..., 3:] / 255
    return np.rint(rgba[..., :3] * cover + background * (1 - cover)).astype(np.uint8)


def ring(count: int = 9, distance: float = 4.0, **lens: object) -> list[Eye]:
    """Cameras on an arc above the dots, world +z up."""
    eyes = []
    for index in range(count):
        angle = 0.3 + 4.5 * index / count
        position = distance * np.array([np.cos(angle) * 0.9, np.sin(angle) * 0.9, 0.43])
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rows = np.stack([right, np.cross(forward, right), forward])
        eyes.append(replace(Eye(rows, -rows @ position), **lens))
    return eyes


def save(picture: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)


def errors(scene: Scene, view: View) -> np.ndarray:
    """Distance in pixels between a dot's centre of gravity in the picture and where the view's camera projects it.

    A dot of the wrong colour counts as infinitely far; dots close to another one or to the border are left out.
    """
    local = np.linalg.inv(scene.world_from_local.double().numpy())
    points = torch.from_numpy(POINTS @ local[:3, :3].T + local[:3, 3]).float()
    projected, z = view.camera.project(points)
    assert float(z.min()) > 0, "every dot is in front of every camera"
    picture = view.over(torch.zeros(3)).numpy()
    apart = torch.cdist(projected, projected) + 1e3 * torch.eye(len(projected))
    reach = round(6 * view.camera.width / 160)
    alone = apart.amin(dim=1) > 2 * reach
    alone &= ((projected > reach) & (projected < projected.new_tensor([view.camera.width, view.camera.height]) - reach)).all(
        dim=1
    )
    assert int(alone.sum()) >= 1
    result = []
    for (x, y), colour in zip(projected[alone].tolist(), COLOURS[alone.numpy()], strict=True):
        rows = np.arange(int(y) - reach, int(y) + reach + 1)
        columns = np.arange(int(x) - reach, int(x) + reach + 1)
        weight = picture[np.ix_(rows, columns)].sum(-1)
        weight = np.where(weight > 0.25 * weight.max(), weight, 0)
        centre = np.array([(weight.sum(0) * (columns + 0.5)).sum(), (weight.sum(1) * (rows + 0.5)).sum()]) / weight.sum()
        found = picture[int(centre[1]), int(centre[0])]
        same = np.abs(found / found.max() - colour).max() < 0.2
        result.append(np.linalg.norm(centre - (x, y)) if same else np.inf)
    return np.array(result)


def assert_dots_are_found(scene: Scene, within: float = 0.3) -> None:
    """Every dot of every view lies where the loaded camera projects it."""
    for view in (*scene.train, *scene.val, *scene.test):
        worst = errors(scene, view).max()
        assert worst < within, f"{view.name}: {worst:.2f} px"
