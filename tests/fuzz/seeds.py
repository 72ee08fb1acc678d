"""The smallest good input of every reader: three photographs of 12 x 9 pixels and their cameras, twenty Gaussians, a recipe."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path

import folders
import numpy as np
from dots import GL, POINTS, Eye, ring, save
from gaussian_files import cloud
from scipy.spatial.transform import Rotation

SIZE = (12, 9)
FOCAL, CENTRE = (11.0, 11.0), (6.0, 4.5)
DATA = Path(__file__).parents[2]


def eyes() -> list[Eye]:
    """Three cameras around the dots."""
    return ring(3, focal=FOCAL, centre=CENTRE, size=SIZE)


def picture(index: int) -> np.ndarray:
    """Colours that all differ, so that no pixel can change unnoticed."""
    return np.random.default_rng(index).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def photographs(folder: Path) -> None:
    """The three photographs as PNG."""
    for index in range(3):
        save(picture(index), folder / f"{index}.png")


def _frames(folder: str = "images") -> list[dict[str, object]]:
    return [
        {"file_path": f"{folder}/{index}.png", "transform_matrix": (eye.cam_to_world @ GL).tolist()}
        for index, eye in enumerate(eyes())
    ]


def nerfstudio(root: Path) -> str:
    """``transforms.json`` with a lens."""
    photographs(root / "images")
    top = {"fl_x": 11.0, "fl_y": 11.0, "cx": 6.0, "cy": 4.5, "w": 12, "h": 9, "k1": 0.05, "camera_model": "OPENCV"}
    (root / "transforms.json").write_text(json.dumps(top | {"frames": _frames()}))
    return "transforms.json"


def blender(root: Path) -> str:
    """``transforms_train.json`` and its test set."""
    photographs(root / "images")
    for split, frames in (("train", _frames()[:2]), ("test", _frames()[2:])):
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    return "transforms_train.json"


def llff(root: Path) -> str:
    """``poses_bounds.npy``."""
    photographs(root / "images")
    rows = []
    for eye in eyes():
        right, down, forward = eye.R
        matrix = np.stack([down, right, -forward, -eye.R.T @ eye.t, np.array([9.0, 12.0, 11.0])], axis=1)
        rows.append([*matrix.ravel(), 2.0, 20.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return "poses_bounds.npy"


def idr(root: Path) -> str:
    """``cameras.npz``."""
    photographs(root / "image")
    arrays = {}
    for index, eye in enumerate(eyes()):
        projection = np.eye(4)
        K = np.array([[FOCAL[0], 0, CENTRE[0] - 0.5], [0, FOCAL[1], CENTRE[1] - 0.5], [0, 0, 1]])
        projection[:3] = K @ np.concatenate([eye.R, eye.t[:, None]], axis=1)
        arrays |= {f"world_mat_{index}": projection, f"scale_mat_{index}": np.diag([2.0, 2.0, 2.0, 1.0])}
    np.savez(root / "cameras.npz", **arrays)
    return "cameras.npz"


def npz(root: Path) -> str:
    """The project's own convention."""
    np.savez(
        root / "scene.npz",
        images=np.stack([picture(index) for index in range(3)]),
        cam_to_world=np.stack([eye.cam_to_world for eye in eyes()]),
        focal=np.array(FOCAL),
        centre=np.array(CENTRE),
        points=POINTS,
        bounds=np.array([[-2.0, -2, -2], [2, 2, 2]]),
    )
    return "scene.npz"


def _colmap(root: Path) -> Path:
    photographs(root / "images")
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    images = []
    for index, eye in enumerate(eyes()):
        x, y, z, w = Rotation.from_matrix(eye.R).as_quat()
        images.append(f"{index + 1} {w} {x} {y} {z} {' '.join(map(str, eye.t))} 1 {index}.png\n1.5 2.5 {index + 1}\n")
    (folder / "cameras.txt").write_text("1 OPENCV 12 9 11 11 6 4.5 0.05 0 0 0\n")
    (folder / "images.txt").write_text("".join(images))
    points = [f"{i + 1} {' '.join(map(str, point))} 10 20 30 0.1 {i + 1} 0" for i, point in enumerate(POINTS[:3])]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return folder


def colmap_text(root: Path) -> str:
    """A COLMAP model as text."""
    _colmap(root)
    return "sparse/0/*.txt"


def colmap_binary(root: Path) -> str:
    """The same as COLMAP writes it in binary."""
    import pycolmap

    folder = _colmap(root)
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()
    return "sparse/0/*.bin"


def images(root: Path) -> str:
    """The photographs of a good ``transforms.json``."""
    nerfstudio(root)
    return "images/*.png"


def _gaussians(root: Path, name: str, form: str) -> str:
    from invgraphics.formats.base import Splats, write_gaussians

    write_gaussians(root / name, form, Splats(cloud(20, 1), "RUB" if form == "spz" else None))
    return name


def ply(root: Path) -> str:
    """3DGS's PLY."""
    return _gaussians(root, "cloud.ply", "ply")


def splat(root: Path) -> str:
    """``.splat``."""
    return _gaussians(root, "cloud.splat", "splat")


def spz(root: Path) -> str:
    """SPZ, version 4."""
    return _gaussians(root, "cloud.spz", "spz")


def old_spz(root: Path) -> str:
    """SPZ, version 3, which is gzip."""
    body = np.random.default_rng(0).integers(0, 256, 20 * 20, dtype=np.uint8).tobytes()
    (root / "cloud.spz").write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 20, 0, 12, 0, 0) + body, mtime=0))
    return "cloud.spz"


def compressed_ply(root: Path) -> str:
    """PlayCanvas's compressed PLY."""
    ends = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {name}" for name in ends)]
    header += ["element vertex 20", *(f"property uint {name}" for name in packed), "end_header", ""]
    chunk = np.array([-1, -1, -1, 1, 1, 1, -5, -5, -5, -2, -2, -2], "<f4")
    words = np.random.default_rng(0).integers(0, 2**32, (20, 4), dtype=np.uint32).astype("<u4")
    (root / "cloud.compressed.ply").write_bytes("\n".join(header).encode() + chunk.tobytes() + words.tobytes())
    return "cloud.compressed.ply"


def recipe(root: Path) -> str:
    """A recipe of our own."""
    (root / "mine.toml").write_text((DATA / "renderers" / "splatting" / "gaussians.toml").read_text())
    return "mine.toml"


def study(root: Path) -> str:
    """A study."""
    lines = ['question = "Which?"', 'scenes = ["bricks"]', 'methods = ["volumetric/hash", "volumetric/nerf"]', "seeds = [0, 1]"]
    lines += ['budget = "60s"', "size = 100", "[factors]", '"data.train_views" = [5, 10]', '"batches.rays" = [512, 1024]']
    (root / "study.toml").write_text("\n".join(lines) + "\n")
    return "study.toml"


SCENES: tuple[Callable[[Path], str], ...] = (nerfstudio, blender, llff, idr, npz, colmap_text, colmap_binary, images)
GAUSSIANS: tuple[Callable[[Path], str], ...] = (ply, compressed_ply, splat, spz, old_spz)
TABLES: tuple[Callable[[Path], str], ...] = (recipe, study)
FOLDERS: dict[str, tuple[str, Callable[[Path], str]]] = {
    "run": ("run", folders.run_folder),
    "comparison": ("comparison", folders.comparison_folder),
    "study_cells": ("study_cells", folders.study_folder),
    "pictures": ("pictures", folders.run_pictures),
    "checkpoint": ("checkpoint", folders.checkpoint),
    "rendered": ("scene", folders.rendered_scene),
    "description": ("description", folders.description),
    "camera_path": ("camera_path", folders.camera_path),
    "report_of_runs": ("page", folders.comparison_folder),
    "report_of_pictures": ("run_page", folders.run_pictures),
    "report_of_a_study": ("study_page", folders.study_folder),
}
"""Folders that invgraphics writes: seed -> which reader reads it, and what writes it."""
SEEDS = {make.__name__: make for make in (*SCENES, *GAUSSIANS, *TABLES)} | {name: make for name, (_, make) in FOLDERS.items()}
"""Reader -> writes a good input into a folder and names, as a pattern, the files that are mutated."""
