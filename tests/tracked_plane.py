"""A patterned plane in photographs under known exposures, with the points that each shows; also as a COLMAP workspace."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from invgraphics.core import Camera, View
from invgraphics.core.transforms import look_at, opencv_to_colmap

SIZE = 64


def photographs(factors: list[float], shiny: float = 0.0, seed: int = 0) -> tuple[list[View], torch.Tensor, list[torch.Tensor]]:
    """Photographs of a patterned plane z = 0 under known exposures, its points, and the rows of those that each shows."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.cat([torch.rand(400, 2, generator=generator) * 1.6 - 0.8, torch.zeros(400, 1)], dim=1)
    views, observed = [], []
    for index, factor in enumerate(factors):
        angle = 2 * math.pi * index / len(factors)
        pose = look_at(torch.tensor([math.cos(angle), math.sin(angle), 3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        camera = Camera(pose, torch.tensor([80.0, 80.0]), torch.tensor([32.0, 32.0]), SIZE, SIZE)
        rays = camera.rays()
        place = rays.origins + rays.directions * (-rays.origins[:, 2] / rays.directions[:, 2])[:, None]
        pattern = 0.3 + 0.15 * torch.sin(5 * place[:, :1]) * torch.cos(4 * place[:, 1:2])
        colour = (pattern * torch.tensor([1.0, 0.8, 0.6]) * factor).expand(-1, 3).clone()
        lit = torch.rand(len(colour), generator=generator) < shiny
        colour[lit] = 0.9
        views.append(View(camera, colour.reshape(SIZE, SIZE, 3), f"{index}"))
        kept = torch.rand(len(points), generator=generator) < 0.6
        observed.append(kept.nonzero().flatten())
    return views, points, observed


def workspace(path: Path, factors: list[float]) -> Path:
    """The photographs as a COLMAP workspace, tracks included."""
    views, points, observed = photographs(factors)
    (path / "sparse/0").mkdir(parents=True)
    (path / "images").mkdir()
    images = []
    for number, (view, rows) in enumerate(zip(views, observed, strict=True), 1):
        Image.fromarray((view.image * 255).round().byte().numpy()).save(path / "images" / f"{number}.png")
        world_to_cam = opencv_to_colmap(view.camera.cam_to_world.double()).numpy()
        x, y, z, w = Rotation.from_matrix(world_to_cam[:3, :3]).as_quat()
        tracks = " ".join(f"0 0 {3 * row + 7}" for row in rows.tolist())
        images.append(f"{number} {w} {x} {y} {z} {' '.join(map(str, world_to_cam[:3, 3]))} 1 {number}.png\n{tracks}")
    (path / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} 80 80 32 32\n")
    (path / "sparse/0/images.txt").write_text("\n".join(images) + "\n")
    lines = [f"{3 * row + 7} {' '.join(map(str, point))} 90 90 90 0.1" for row, point in enumerate(points.tolist())]
    (path / "sparse/0/points3D.txt").write_text("\n".join(reversed(lines)) + "\n")
    return path
