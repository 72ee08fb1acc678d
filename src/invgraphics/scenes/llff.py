"""LLFF's forward-facing photographs: ``poses_bounds.npy`` beside ``images``."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.arrays import read_array
from invgraphics.core import Camera, Scene
from invgraphics.core.believable import LONGEST_SIDE
from invgraphics.core.transforms import llff_to_opencv
from invgraphics.errors import InputError
from invgraphics.scenes.colmap_workspace import find_model, model_folders
from invgraphics.scenes.layout import SceneOptions, compose, every_eighth, scene_name
from invgraphics.scenes.pictures.images import Photo, image_files
from invgraphics.scenes.poses import pose
from invgraphics.scenes.region import contracted_frame

SOURCE = "poses_bounds.npy"


class Llff:
    """Loader of LLFF folders: one pinhole per photograph, near and far bounds, every eighth photograph scored.

    The scene is unbounded. Where the cameras look in parallel, the subject lies where LLFF focuses: in disparity a quarter of
    the way from the far bound to the near one.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with ``poses_bounds.npy``, or that file.

        A folder that has the COLMAP model, too, from which LLFF made it, and that model's photographs is COLMAP's, which has
        lenses and points.
        """
        named = path.name == SOURCE and path.is_file()
        return named or ((path / SOURCE).is_file() and not _is_of_colmap(path))

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load poses, near and far bounds and photographs as an unbounded scene.

        Raises:
            InputError: a file is missing or unusable, or there are more or fewer pictures than poses.
        """
        path = path.parent if path.is_file() else path
        source = path / SOURCE
        table = _read(source)
        files = _pictures(path)
        if len(files) != len(table):
            raise InputError(f"{files[0].parent} has {len(files)} pictures, {source} has {len(table)} poses.")
        photos = [
            _photo(row, file, f"{source}, row {index}") for index, (row, file) in enumerate(zip(table, files, strict=True))
        ]
        near, far = float(table[:, 15].min()), float(table[:, 16].max())
        if not 0 < near < far < math.inf:
            raise InputError(f"The depth bounds of {source} are {near:g} and {far:g}, not positive and increasing.")
        poses = torch.stack([photo.camera.cam_to_world for photo in photos])
        # LLFF's own numbers: 10% in front of the nearest bound; focus between that and five times the farthest.
        frame = contracted_frame(poses, distance=1 / (0.25 / (0.9 * near) + 0.75 / (5 * far)), near=0.9 * near)
        return compose(scene_name(path), every_eighth(photos), frame, options, {"loader": "llff"})


def _is_of_colmap(path: Path) -> bool:
    """Whether a folder is a COLMAP workspace whose photographs are there."""
    try:
        return bool(model_folders(path)) and find_model(path).present > 0
    except InputError:
        return False


def _read(source: Path) -> Float[np.ndarray, "n 17"]:
    table = read_array(source)
    if table.ndim != 2 or table.shape[1] != 17 or len(table) == 0 or table.dtype.kind != "f":
        raise InputError(f"{source} has shape {table.shape}, expected n rows of 17 numbers.")
    return table.astype(np.float64)


def _pictures(path: Path) -> list[Path]:
    """List the photographs at the highest available resolution: ``images``, else ``images_4`` and the like."""
    scaled = sorted((int(f.name[7:]), f) for f in path.glob("images_*") if f.is_dir() and f.name[7:].isdecimal())
    for folder in (path / "images", *(folder for _, folder in scaled)):
        if files := image_files(folder):
            return files
    raise InputError(f"{path} has poses_bounds.npy but no pictures in 'images'.")


def _photo(row: Float[np.ndarray, 17], file: Path, where: str) -> Photo:
    values = torch.from_numpy(row[:15].reshape(3, 5))
    height, width, focal = values[:, 4].tolist()
    if not (1 <= height <= LONGEST_SIDE and 1 <= width <= LONGEST_SIDE and 0 < focal < math.inf):
        raise InputError(f"Height, width and focal length of {where} are {height:g}, {width:g} and {focal:g}.")
    cam_to_world = pose(llff_to_opencv(values[:, :4]), where)
    centre = torch.tensor([width / 2, height / 2], dtype=torch.float64)
    camera = Camera(cam_to_world, torch.full_like(centre, focal), centre, round(width), round(height))
    return Photo(file, camera, file.name)
