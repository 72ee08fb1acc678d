"""Photographs of a box on a floor, traced in plain numpy: unique pictures on its faces, or the same one on all of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from dots import GL, Eye, save

from invgraphics.scenes.mitsuba.build.noise import confetti

PALETTES = [
    [(0.02, 0.05, 0.2), (0.8, 0.7, 0.3), (0.9, 0.9, 0.8), (0.7, 0.1, 0.05)],
    [(0.1, 0.3, 0.1), (0.6, 0.8, 0.5), (0.9, 0.3, 0.1)],
]
FLOOR = 1.6  # half width


def orbit(count: int, size: int, arc: float = 360.0, distance: float = 3.0) -> list[Eye]:
    """Cameras around the box within ``arc`` degrees, at two heights in turn."""
    eyes = []
    for index in range(count):
        azimuth, height = np.radians(arc) * index / count, 0.35 if index % 2 else 0.75
        forward = -np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rows = np.stack([right, np.cross(forward, right), forward])
        position = np.array([0, 0, 0.4]) - distance * forward
        eyes.append(Eye(rows, -rows @ position, (1.3 * size, 1.3 * size), (size / 2, size / 2), (size, size)))
    return eyes


class Box:
    """A unit cube that stands on a square floor.

    Args:
        repeated: whether all faces show the same picture.
        floor: whether the floor has a picture of its own, or is plain.
        texels: edge of a face's picture.
    """

    def __init__(self, repeated: bool, floor: bool = True, texels: int = 256) -> None:
        rng = np.random.default_rng(0)
        faces = [confetti(texels, PALETTES[0], rng) for _ in range(1 if repeated else 6)]
        self._faces = faces * 6 if repeated else faces
        self._floor = confetti(2 * texels, PALETTES[1], rng, shapes=200) if floor else np.full((2, 2, 3), 0.4)

    def photograph(self, eye: Eye, rays: int = 2) -> np.ndarray:
        """Bytes (h, w, 3), averaged over ``rays`` x ``rays`` rays per pixel."""
        width, height = eye.size
        x, y = (np.arange(rays * side) + 0.5 for side in (width, height))
        image = np.stack(np.meshgrid(x / rays, y / rays), axis=-1).reshape(-1, 2)
        plane = (image - eye.centre) / eye.focal
        directions = np.column_stack([plane, np.ones(len(plane))]) @ eye.R
        colour = self._trace(eye.cam_to_world[:3, 3], directions)
        colour = colour.reshape(height, rays, width, rays, 3).mean(axis=(1, 3))
        return np.rint(255 * colour.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)

    def _trace(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        colour = np.full((len(direction), 3), 0.15)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / direction[:, 2]
            hit = origin + distance[:, None] * direction
            on = (distance > 0) & (np.abs(hit[:, :2]).max(axis=1) < FLOOR)
            colour[on] = _sample(self._floor, (hit[on, :2] + FLOOR) / (2 * FLOOR))
            slabs = np.sort((np.array([[-0.5, -0.5, 0], [0.5, 0.5, 1]])[:, None] - origin) / direction, axis=0)
        entry, leave = slabs[0].max(axis=1), slabs[1].min(axis=1)
        struck = (entry < leave) & (entry > 0)
        hit = origin + entry[:, None] * direction
        axis = slabs[0].argmax(axis=1)
        for number in range(6):
            mine = struck & (axis == number // 2) & ((direction[:, number // 2] < 0) == (number % 2 == 1))
            first, second = ((1, 2), (0, 2), (0, 1))[number // 2]
            uv = np.stack([hit[mine, first] + 0.5, hit[mine, second] + (0.5 if second == 1 else 0)], axis=1)
            # Seen from outside, no side is mirrored.
            uv[:, 0] = uv[:, 0] if number in (1, 2) else 1 - uv[:, 0]
            colour[mine] = _sample(self._faces[number], uv)
        return colour


def _sample(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear."""
    size = np.array(picture.shape[:2])
    place = (uv[:, ::-1] * size - 0.5).clip(0, size - 1.001)
    low = place.astype(int)
    (a, b), (i, j) = (place - low).T[:, :, None], low.T
    top = picture[i, j] * (1 - b) + picture[i, j + 1] * b
    return top * (1 - a) + (picture[i + 1, j] * (1 - b) + picture[i + 1, j + 1] * b) * a


def shoot(folder: Path, box: Box, eyes: list[Eye]) -> Path:
    """Photographs in ``folder``/images, and the truth about their cameras beside it; returns the photographs' folder."""
    frames = []
    for index, eye in enumerate(eyes):
        name = f"images/{index:03}.png"
        save(box.photograph(eye), folder / name)
        frames.append({"file_path": name, "transform_matrix": (eye.cam_to_world @ GL).tolist()})
    first = eyes[0]
    lens = {"fl_x": first.focal[0], "fl_y": first.focal[1], "w": first.size[0], "h": first.size[1], "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder / "images"


def poses(eyes: list[Eye]) -> torch.Tensor:
    return torch.from_numpy(np.stack([eye.cam_to_world for eye in eyes]))
