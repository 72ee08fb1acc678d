"""Recovered poses against the poses that come with the photographs."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.errors import InputError
from invgraphics.scenes.photos import PhotoJob
from invgraphics.tools import photos as module
from invgraphics.tools.photos import compare, import_photos

GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def data_set(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """Nine tiny pictures with poses; returns the folder and the OpenCV poses."""
    from PIL import Image

    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = Rotation.random(9, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(9, 3))
    (tmp_path / "set/images").mkdir(parents=True)
    frames = []
    for index, pose in enumerate(poses):
        Image.fromarray(np.full((16, 16, 3), index, np.uint8)).save(tmp_path / f"set/images/{index:04}.png")
        frames.append({"file_path": f"images/{index:04}.png", "transform_matrix": (pose @ GL).tolist()})
    table = {"fl_x": 20, "w": 16, "h": 16, "camera_model": "PINHOLE", "frames": frames}
    (tmp_path / "set/transforms.json").write_text(json.dumps(table))
    return tmp_path / "set", poses


def report(poses: np.ndarray, names: list[str]) -> dict:
    """Poses seen from another world, the last one turned by 10 degrees."""
    turn, cameras = Rotation.from_euler("xyz", [20, 40, 60], degrees=True).as_matrix(), []
    for index, (pose, name) in enumerate(zip(poses, names, strict=True)):
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn @ pose[:3, :3], 0.2 * turn @ pose[:3, 3] + [5, 6, 7]
        if index == len(poses) - 1:
            moved[:3, :3] = moved[:3, :3] @ Rotation.from_euler("x", 10, degrees=True).as_matrix()
        cameras.append({"source": name, "cam_to_world": moved.tolist()})
    return {"cameras": cameras, "registered": len(cameras), "usable": True}


def test_errors_are_those_of_the_poses_by_name(data_set) -> None:
    folder, poses = data_set
    order = [3, 1, 8, 0, 5]
    truth = compare(folder / "images", report(poses[order], [f"{index:04}.JPG" for index in order]), folder)
    assert truth["cameras"] == 5
    assert truth["rotation_degrees"]["max"] == pytest.approx(10, abs=1e-3)
    assert truth["rotation_degrees"]["median"] == pytest.approx(0, abs=1e-3)
    assert truth["translation_per_cent"]["max"] == pytest.approx(0, abs=1e-3)
    assert truth["scale"] == pytest.approx(5, rel=1e-4)


def test_poses_are_compared_without_the_pictures_in_memory(data_set, monkeypatch) -> None:
    """Of each picture a thousandth of the pixels is kept; poses are those of the full size."""
    from PIL import Image

    from invgraphics.scenes.nerfstudio import Nerfstudio

    folder, poses = data_set
    for path in (folder / "images").iterdir():
        Image.new("RGB", (1024, 1024)).save(path)
    load, scenes = Nerfstudio.load, []
    monkeypatch.setattr(Nerfstudio, "load", lambda *arguments: scenes.append(load(*arguments)) or scenes[-1])
    truth = compare(folder / "images", report(poses, [f"{index:04}.png" for index in range(9)]), folder)
    kept = sum(view.image.numel() for view in (*scenes[0].train, *scenes[0].test))
    assert kept < 9 * 1024 * 1024 * 3 / 1000
    assert (truth["cameras"], truth["rotation_degrees"]["max"]) == (9, pytest.approx(10, abs=1e-3))


@pytest.mark.parametrize("shape", [(16, 16), (20, 16)])
@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_cameras_of_turned_photographs_are_compared_as_stored(data_set, orientation: int, shape: tuple[int, int]) -> None:
    """The upright picture's camera is the stored one's after a turn about its optical axis; of mirrored ones there is none."""
    from PIL import Image

    folder, poses = data_set
    width, height = shape
    table = json.loads((folder / "transforms.json").read_text()) | {"w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps(table))
    for path in (folder / "images").iterdir():
        Image.new("RGB", shape).save(path)
    degrees = {1: 0, 2: 0, 3: 180, 6: -90, 8: 90}[orientation]
    upright = poses.copy()
    upright[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    size = [height, width] if orientation in (6, 8) else [width, height]

    def quality(found: np.ndarray) -> dict:
        told = report(found, [f"{index:04}.png" for index in range(9)])
        return told | {"cameras": [camera | {"size": size, "orientation": orientation} for camera in told["cameras"]]}

    if orientation == 2:
        with pytest.raises(InputError, match="has poses of 0 of the 9"):
            compare(folder, quality(upright), folder)
        return
    assert compare(folder, quality(upright), folder)["rotation_degrees"]["median"] == pytest.approx(0, abs=1e-3)
    if orientation in (6, 8) and width != height:  # a data set of the upright pictures
        (folder / "transforms.json").write_text(json.dumps(table | {"w": height, "h": width}))
        for path in (folder / "images").iterdir():
            Image.new("RGB", (height, width)).save(path)
        assert compare(folder, quality(poses), folder)["rotation_degrees"]["median"] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_stored_picture_shows_what_the_upright_one_does(orientation: int) -> None:
    """Pillow turns the stored picture upright; the pixel of a point goes where the upright camera sees the point."""
    from PIL import Image, ImageOps

    upright = torch.eye(4, dtype=torch.float64)
    upright[:3, :3] = torch.from_numpy(Rotation.random(random_state=2).as_matrix())
    upright[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    size = (40, 30) if orientation in (1, 3) else (30, 40)
    point = upright[:3, :3] @ torch.tensor([-1.5, 0.7, 5.0], dtype=torch.float64) + upright[:3, 3]

    def pixel(pose: torch.Tensor, size: tuple[int, int]) -> tuple[int, int]:
        x, y, z = (pose[:3, :3].T @ (point - pose[:3, 3])).tolist()
        return int(size[0] / 2 + 50 * x / z), int(size[1] / 2 + 50 * y / z)

    stored = Image.new("L", size)
    stored.putpixel(pixel(module.upright_to_stored(upright, orientation), size), 255)
    exif = stored.getexif()
    exif[0x0112] = orientation
    assert ImageOps.exif_transpose(stored).getpixel(pixel(upright, (40, 30))) == 255


def test_other_photographs_are_refused(data_set) -> None:
    folder, poses = data_set
    with pytest.raises(InputError, match="has poses of 0 of the 9"):
        compare(folder / "images", report(poses, [f"other{index}.png" for index in range(9)]), folder)


def test_names_that_splits_share_need_the_folder(tmp_path: Path) -> None:
    from invgraphics.core import Bounds, Camera, Scene, View

    def view(number: float) -> View:
        pose = torch.eye(4)
        pose[0, 3] = number
        return View(Camera(pose, torch.ones(2), torch.ones(2), 2, 2), torch.zeros(2, 2, 3), "0000")

    scene = Scene("s", (view(1),), (view(2),), torch.zeros(3), Bounds(-torch.ones(3), torch.ones(3)))
    known = module.true_cameras(scene)
    assert known["0000"] is None
    assert [float(known[name].cam_to_world[0, 3]) for name in ("train/0000", "test/0000", "test-0000")] == [1, 2, 2]
    assert module._lookup(known, tmp_path / "test", "0000.png") is known["test/0000"]
    assert module._lookup(known, tmp_path / "other", "0000.png") is None


def test_truth_beside_the_photographs_is_found_and_written_down(data_set, tmp_path: Path, monkeypatch) -> None:
    folder, poses = data_set
    out = tmp_path / "out"
    out.mkdir()
    quality = report(poses, [f"{index:04}.png" for index in range(9)])
    monkeypatch.setattr(module, "reconstruct", lambda *_: dict(quality))
    found = import_photos(PhotoJob(str(folder / "images")), out)
    assert found["truth"]["source"] == str(folder)
    assert json.loads((out / "quality.json").read_text()) == found
    elsewhere = tmp_path / "photos"
    elsewhere.mkdir()
    assert "truth" not in import_photos(PhotoJob(str(elsewhere)), out)
    assert import_photos(PhotoJob(str(elsewhere)), out, truth=folder)["truth"]["cameras"] == 9


def test_a_truth_that_is_none_is_refused_before_the_work(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(module, "reconstruct", lambda *_: pytest.fail("work was started"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty folder"):
        import_photos(PhotoJob(str(tmp_path)), tmp_path / "out", truth=tmp_path / "empty")
