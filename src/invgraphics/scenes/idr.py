"""IDR's and NeuS's layout of DTU and BlendedMVS: ``cameras*.npz`` beside ``image`` and ``mask``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.arrays import read_arrays
from invgraphics.core import Bounds, Camera, Scene
from invgraphics.core.transforms import colmap_to_opencv
from invgraphics.errors import InputError
from invgraphics.scenes.dtu import find_scan
from invgraphics.scenes.layout import SceneOptions, compose, every_eighth
from invgraphics.scenes.pictures.images import Photo, image_files, stored_size
from invgraphics.scenes.poses import pose
from invgraphics.scenes.region import NEAR, LocalFrame

_NAMES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")

OFF_CENTRE = 0.8
"""Share of the picture's width and height beyond which no lens has its centre: of pictures at half of their size it is at 1."""


class Idr:
    """Loader of ``cameras*.npz``: projection matrices ``world_mat_i`` and the subject's sphere ``scale_mat_i``.

    The local frame is the one in which the subject fills the unit sphere, bounds are ±1. With masks these are the coverage and
    the scene is a box; without, the surroundings are part of the picture and the scene is contracted. Every eighth
    photograph by name is scored. A reference scan of DTU beside the cameras scores surfaces (see `scenes.dtu`).
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with ``cameras*.npz``."""
        return _source(path) is not None

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load cameras, photographs and masks: a box with masks, else a contracted scene.

        Raises:
            InputError: a file or a key is missing or unusable, or there are fewer matrices or masks than pictures.
        """
        source = _source(path)
        if source is None:
            raise InputError(f"{path} has none of {', '.join(_NAMES)}.")
        files = image_files(path / "image")
        masks = image_files(path / "mask")
        if not files:
            raise InputError(f"{path} has {source.name} but no pictures in 'image'.")
        if masks and len(masks) != len(files):
            raise InputError(f"{path / 'mask'} has {len(masks)} masks, {path / 'image'} has {len(files)} pictures.")
        world_from_local, cameras = _cameras(source, files)
        photos = [
            Photo(file, camera, file.name, alpha=masks[index] if masks else None)
            for index, (file, camera) in enumerate(zip(files, cameras, strict=True))
        ]
        bounds = Bounds(-torch.ones(3), torch.ones(3), "box" if masks else "contracted", NEAR)
        scan, lacks = find_scan(path if path.is_dir() else path.parent)
        notes = {"loader": "idr", "cameras": source.name, "reference_scan": lacks.lstrip("; ") or "with mask and plane"}
        scene = compose(path.resolve().name, every_eighth(photos), LocalFrame(bounds, world_from_local), options, notes)
        return replace(scene, scan=scan)


def _source(path: Path) -> Path | None:
    return next((path / name for name in _NAMES if (path / name).is_file()), None)


def _cameras(source: Path, files: list[Path]) -> tuple[Float[Tensor, "4 4"], list[Camera]]:
    arrays = read_arrays(source)
    sphere = _matrix(arrays, "scale_mat_0", source)
    world_from_local = torch.from_numpy(sphere)
    # The sphere's matrix is a similarity exactly if its linear part without the scale is rigid.
    scale = torch.linalg.det(world_from_local[:3, :3]).abs() ** (1 / 3)
    if not 0 < float(scale) < math.inf or not np.array_equal(sphere[3], [0, 0, 0, 1]):
        raise InputError(f"The scale_mat_0 of {source} is no similarity: its determinant is {float(scale) ** 3:g}.")
    pose(torch.cat([world_from_local[:3, :3] / scale, world_from_local[:3, 3:]], dim=1), f"{source}, scale_mat_0")
    cameras = []
    for index, file in zip(_numbers(arrays, files, source), files, strict=True):
        if np.abs(_matrix(arrays, f"scale_mat_{index}", source) - sphere).max() > 1e-6 * np.abs(sphere).max():
            raise InputError(f"{source} has a scale_mat_{index} that differs from scale_mat_0.", "One sphere is expected.")
        camera = decompose(_matrix(arrays, f"world_mat_{index}", source)[:3], stored_size(file), f"{source}, world_mat_{index}")
        cameras.append(camera)
    _check_centres(cameras, source)
    return world_from_local, cameras


def _check_centres(cameras: list[Camera], source: Path) -> None:
    """Refuse pictures that were resized without their matrices, which hold no size.

    Raises:
        InputError: in most views the principal point lies near or beyond the same end of both sides.
    """
    places = [camera.principal_point / torch.tensor([camera.width, camera.height]) for camera in cameras]
    x, y = torch.stack(places).median(dim=0).values.tolist()
    if min(x, y) > OFF_CENTRE or max(x, y) < 1 - OFF_CENTRE:
        what = f"The principal points of {source} lie at {x:.2f} of the pictures' width and {y:.2f} of their height"
        raise InputError(f"{what}: pictures were resized without their matrices.", "Use those of the full size, and --size.")


def _numbers(arrays: Mapping[str, np.ndarray], files: list[Path], source: Path) -> list[int]:
    """Number of each picture's matrices: that of its name where all have one with matrices, else its rank.

    Raises:
        InputError: there are more matrices than pictures, and names do not tell whose they are.
    """
    count = sum(key.startswith("world_mat_") and key.removeprefix("world_mat_").isdecimal() for key in arrays)
    named = [int(file.stem) for file in files if file.stem.isdecimal() and f"world_mat_{int(file.stem)}" in arrays]
    if len(set(named)) == len(files):
        if 0 not in named and count > len(files):
            print(f"{files[0].name} has the camera world_mat_{named[0]} of {source}: names count from 0.", file=sys.stderr)
        return named
    if count > len(files):
        raise InputError(
            f"{source} has {count} cameras, and there are {len(files)} pictures.", "Name pictures by their camera's number."
        )
    return list(range(len(files)))


def _matrix(arrays: Mapping[str, np.ndarray], key: str, source: Path) -> Float[np.ndarray, "4 4"]:
    if key not in arrays:
        raise InputError(f"{source} has no '{key}'.", "One world_mat and one scale_mat per picture are expected.")
    if arrays[key].shape != (4, 4) or arrays[key].dtype.kind not in "fiu" or not np.isfinite(arrays[key]).all():
        raise InputError(f"'{key}' of {source} is not a finite 4x4 matrix.")
    return arrays[key].astype(np.float64)


def decompose(projection: Float[np.ndarray, "3 4"], size: tuple[int, int], where: str) -> Camera:
    """Decompose a projection matrix to a camera by RQ decomposition (Hartley and Zisserman, §6.2.4).

    DTU's pixel coordinates put the first pixel's centre at (0, 0), ours at (0.5, 0.5).

    Args:
        projection: maps homogeneous world points to homogeneous pixels; its scale and sign do not matter.
        size: (width, height) of the picture.
        where: file and view, for messages.
    """
    from scipy.linalg import rq

    if np.linalg.matrix_rank(projection[:, :3]) < 3:
        raise InputError(f"{where} is not a projection matrix: its left part is singular.")
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    upper, rotation = rq(projection[:, :3])
    signs = np.diag(np.sign(np.diag(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    translation = np.linalg.solve(upper, projection[:, 3])
    intrinsics = upper / upper[2, 2]
    if abs(intrinsics[0, 1]) * size[1] / intrinsics[1, 1] > 1:
        raise InputError(f"{where} has skewed pixels (skew {intrinsics[0, 1]:.3g}), which no camera here has.")
    world_to_cam = torch.from_numpy(np.concatenate([rotation, translation[:, None]], axis=1))
    return Camera(
        cam_to_world=pose(colmap_to_opencv(world_to_cam), where),
        focal=torch.from_numpy(np.diag(intrinsics)[:2].copy()),
        principal_point=torch.from_numpy(intrinsics[:2, 2] + 0.5),
        width=size[0],
        height=size[1],
    )
