"""The smallest good folders that invgraphics writes: a run with pictures, a comparison of it, a judged study, a checkpoint."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from judged_folders import entry, write_judged
from PIL import Image

SIZE = (12, 9)
MACHINE = {"schema": 1, "cpu": "A test machine", "threads": 2, "date": "2025-11-21"}
RECORDS = "**/*.json*"


def _run(root: Path) -> Path:
    """A run with three test views and its truth."""
    cell = entry("volumetric/hash", "bricks", 12, "60s")
    write_judged(root.with_name("made"), [cell], known=[])
    shutil.copytree(root.with_name("made") / cell["run"], root, dirs_exist_ok=True)
    shutil.rmtree(root.with_name("made"))
    (root / "environment.json").write_text(json.dumps(MACHINE))
    provenance = json.loads((root / "provenance.json").read_text())
    (root / "provenance.json").write_text(json.dumps(provenance | {"truth": "truth/c0ffee"}))
    (root / "recipe.toml").write_text("[field]\nwidth = 16\n")
    rng, shape = np.random.default_rng(0), SIZE[::-1]
    for folder in ("test", "truth/c0ffee"):
        (root / folder).mkdir(parents=True)
        for view in range(3):
            stem = root / folder / f"{view:04d}"
            Image.fromarray(rng.integers(0, 256, (*shape, 3), dtype=np.uint8)).save(stem.with_suffix(".png"))
            arrays: dict[str, Any] = {"depth": rng.random(shape, np.float32), "alpha": np.ones(shape, np.float16)}
            if folder == "test":
                arrays["rgb"] = rng.random((*shape, 3)).astype(np.float16)
            np.savez(stem.with_suffix(".npz"), **arrays)
    return root


def run_folder(root: Path) -> str:
    """Records of a run."""
    _run(root)
    return RECORDS


def run_pictures(root: Path) -> str:
    """Pictures and arrays of a run, its truth's included."""
    _run(root)
    return "t*/**/*.*"


def comparison_folder(root: Path) -> str:
    """``compare.json`` and the records of its run."""
    _run(root / "runs" / "volumetric-hash" / "seed-0")
    table = {"schema": 1, "scene": "bricks", "question": "How?", "methods": ["volumetric/hash"], "seeds": [0], "budget": "60s"}
    table |= {
        "size": list(SIZE),
        "protocol": {"name": "default"},
        "scene_info": {"train": 3, "test": 3},
        "environment": MACHINE,
    }
    table |= {"runs": ["runs/volumetric-hash/seed-0"], "failures": [], "wall_seconds": 70.0}
    (root / "compare.json").write_text(json.dumps(table))
    return RECORDS


def study_folder(root: Path) -> str:
    """``study.json`` and the records of a run, of a study with a factor."""
    cells = [entry("volumetric/hash", "bricks", 200, "60s"), entry("volumetric/hash", "bricks", 200, "5min", status="missing")]
    write_judged(root, cells, known=[{"cells": "* bricks@200 *", "rule": "views", "cause": "a cause", "issue": 3}])
    table = json.loads((root / "study.json").read_text())
    (root / "study.json").write_text(json.dumps(table | {"factors": {"budget": ["60s", "5min"]}}))
    for path in root.rglob("environment.json"):
        path.write_text(json.dumps(MACHINE))
    return RECORDS


def checkpoint(root: Path) -> str:
    """A checkpoint."""
    import torch

    from invgraphics.runs.checkpoint import save

    sections = {
        "field": {"means": torch.rand(20, 3), "step": torch.tensor(3)},
        "optimiser": {"means.exp_avg": torch.rand(20, 3)},
    }
    save(root / "checkpoint.safetensors", sections)
    return "checkpoint.safetensors"


def rendered_scene(root: Path) -> str:
    """A folder of `invgraphics make-scene`, of a triangle seen by three cameras: all but its pictures, and ``truth.json``."""
    from seeds import CENTRE, FOCAL, eyes, picture

    from invgraphics.scenes.mitsuba import cache, ply

    cameras: dict[str, list[Any]] = {}
    for split, eye in zip(("train", "val", "test"), eyes(), strict=True):
        (root / split).mkdir()
        Image.fromarray(picture(len(cameras))).save(root / split / "0000.png")
        normal = np.broadcast_to(np.array([0, 0, 1], np.float32), (*SIZE[::-1], 3))
        np.savez(root / split / "0000.npz", depth=np.ones(SIZE[::-1], np.float32), normal=normal)
        pose = {"cam_to_world": eye.cam_to_world.tolist(), "focal": FOCAL, "centre": CENTRE}
        cameras[split] = [pose | {"width": SIZE[0], "height": SIZE[1]}]
    np.savez(root / "points.npz", position=np.eye(3, dtype=np.float32), rgb=np.eye(3, dtype=np.float32))
    ply.write(root / "mesh.ply", np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    sizes = {path.relative_to(root).as_posix(): path.stat().st_size for path in sorted(root.rglob("*.*"))}
    table = {"schema": cache.SCHEMA, "key": "c0ffee", "name": "tiny", "summary": "A triangle.", "stresses": "Nothing."}
    table |= {"size": SIZE, "background": None, "bounds": {"lo": [-1.0, -1, -1], "hi": [1.0, 1, 1]}, "files": sizes}
    table |= {"rig": {"kind": "hemisphere"}, "samples_per_pixel": {"train": 4, "val": 4, "test": 4}, "noise_ceiling": 40.0}
    table |= {"seed": 0, "variant": "llvm", "versions": {"mitsuba": "3.6.0"}, "cameras": cameras}
    (root / cache.TRUTH).write_text(json.dumps(table))
    return "**/*.?[!n]*"


def description(root: Path) -> str:
    """A description of a scene of one's own."""
    lines = ['name = "tiny"', 'builder = "materials"', 'summary = "Small."', 'stresses = "Nothing."', "depth = 3"]
    lines += ["lo = [-1.05, -1.05, -0.8]", "hi = [1.05, 1.05, 0.7]", "size = [12, 9]", "background = [1.0, 1.0, 1.0]"]
    lines += ['rig = { kind = "hemisphere", radius = 3.5, fov = 38.0 }', "views = { train = 3, val = 1, test = 1 }"]
    (root / "scene.toml").write_text("\n".join([*lines, "samples = { train = 16, val = 2, test = 32 }", "seed = 1"]) + "\n")
    return "scene.toml"


def camera_path(root: Path) -> str:
    """A camera path as the viewer saves it."""
    from seeds import eyes

    from invgraphics.tools.camera_path import CameraPath, Keyframe

    poses = [torch_pose(eye.cam_to_world) for eye in eyes()]
    CameraPath(tuple(Keyframe(pose, 0.9) for pose in poses), 2.0, loop=True).write(root / "path.json")
    return "path.json"


def torch_pose(pose: np.ndarray) -> Any:
    """A pose as a float64 tensor."""
    import torch

    return torch.from_numpy(np.asarray(pose, np.float64))
