"""NeRF-synthetic folders."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from dots import GL, Eye, assert_dots_are_found, composited, ring, save
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.scenes.blender import Blender
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.open import validate

FOCAL = 170.0


def write(path: Path, splits: dict[str, list[Eye]]) -> None:
    for split, eyes in splits.items():
        frames = []
        for index, eye in enumerate(eyes):
            save(eye.picture(with_alpha=True), path / split / f"r_{index}.png")
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": (eye.cam_to_world @ GL).tolist()})
        table = {"camera_angle_x": 2 * math.atan(80 / FOCAL), "frames": frames}
        (path / f"transforms_{split}.json").write_text(json.dumps(table))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    eyes = ring(14, focal=(FOCAL, FOCAL), centre=(80.0, 60.0))
    write(tmp_path, {"train": eyes[:4], "val": eyes[4:10], "test": eyes[10:]})
    return tmp_path


def test_dots_are_where_the_cameras_say(folder: Path) -> None:
    scene = validate(Blender().load(folder, SceneOptions()))
    assert [len(scene.train), len(scene.val), len(scene.test)] == [4, 4, 4]
    assert_dots_are_found(scene)
    assert scene.background.tolist() == [1, 1, 1]
    assert scene.has_alpha
    assert scene.bounds.space == "box"
    assert scene.bounds.hi.tolist() == [1.5, 1.5, 1.5]
    assert torch.equal(scene.world_from_local, torch.eye(4))
    assert scene.train[2].name == "train/r_2"


def test_pictures_that_only_a_monitor_looks_at_may_be_absent(folder: Path) -> None:
    """As in copies of the data set that are cut down to what is fitted and scored."""
    shutil.rmtree(folder / "val")
    scene = validate(Blender().load(folder, SceneOptions()))
    assert [len(scene.train), len(scene.val), len(scene.test)] == [4, 0, 4]
    assert scene.notes["missing_val"] == "none of the 6 listed files exists"
    shutil.rmtree(folder / "test")
    with pytest.raises(InputError, match="None of the 4 pictures"):
        Blender().load(folder, SceneOptions())


def test_dots_are_found_after_resizing(folder: Path) -> None:
    scene = Blender().load(folder, SceneOptions(size=80, test_views=2, train_views=3))
    assert scene.train[0].image.shape == (60, 80, 3)
    assert [len(scene.train), len(scene.test)] == [3, 2]
    assert_dots_are_found(scene)
    assert "160x120 to 80x60" in scene.notes["resize"]
    assert scene.notes["test_views"] == "2 of 4, evenly spaced"


def test_an_angle_of_view_holds_for_photographs_of_other_sizes(folder: Path) -> None:
    """Cameras have the size of their own photograph, not of the first: each dot is found in the enlarged one too."""
    path = folder / "train" / "r_1.png"
    with Image.open(path) as small:
        small.resize((320, 240), Image.Resampling.BICUBIC).save(path)
    scene = Blender().load(folder, SceneOptions())
    camera = scene.train[1].camera
    assert (camera.width, camera.height) == (320, 240)
    assert camera.focal.tolist() == pytest.approx([2 * FOCAL, 2 * FOCAL], rel=1e-5)
    assert camera.principal_point.tolist() == pytest.approx([160.0, 120.0])
    assert scene.train[0].camera.width == 160


@pytest.mark.parametrize(("size", "place"), [(25.0, (300.0, -120.0, 40.0)), (0.02, (0.3, 0.1, -0.2)), (1.0, (5.0, -3.0, 2.0))])
def test_exports_of_any_size_and_place_get_a_box_of_one_size(
    folder: Path, size: float, place: tuple[float, float, float]
) -> None:
    usual = Blender().load(folder, SceneOptions())
    for split in ("train", "val", "test"):
        path = folder / f"transforms_{split}.json"
        table = json.loads(path.read_text())
        for frame in table["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = size * pose[:3, 3] + place
            frame["transform_matrix"] = pose.tolist()
        path.write_text(json.dumps(table))
    scene = validate(Blender().load(folder, SceneOptions()))
    assert scene.bounds.space == "box"
    assert scene.bounds.hi.tolist() == [1.5, 1.5, 1.5]
    # The ring's cameras look at the dots from 4 units, and show half a width of 80 pixels at a focal length of 170.
    assert scene.scale == pytest.approx(size * 1.05 * 4 * 80 / FOCAL / 1.5, rel=0.01)
    assert torch.allclose(scene.world_from_local[:3, 3], torch.tensor(place), atol=1e-3 * size)
    for view, same in zip(scene.test, usual.test, strict=True):
        dots = torch.tensor([[0.0, 0.0, 0.0], [0.8, 0.1, 0.3]])
        pixels, _ = view.camera.project(dots * size / scene.scale)
        assert torch.allclose(pixels, same.camera.project(dots)[0], atol=0.02)


def opaque(folder: Path, background: np.ndarray, channels: int = 3) -> None:
    for path in folder.rglob("*.png"):
        rgb = composited(np.array(Image.open(path)), background)
        save(np.pad(rgb, ((0, 0), (0, 0), (0, channels - 3)), constant_values=255), path)


@pytest.mark.parametrize("channels", [3, 4])
def test_opaque_pictures_with_a_plain_border_show_an_object_before_it(folder: Path, channels: int) -> None:
    opaque(folder, np.array([51.0, 102.0, 204.0]), channels)
    scene = validate(Blender().load(folder, SceneOptions()))
    assert not scene.has_alpha
    assert scene.bounds.space == "box"
    assert scene.background.tolist() == pytest.approx([0.2, 0.4, 0.8])


@pytest.mark.parametrize("channels", [3, 4])
def test_other_opaque_pictures_show_endless_space(folder: Path, channels: int) -> None:
    opaque(folder, np.random.default_rng(0).uniform(0, 255, (120, 160, 3)), channels)
    scene = validate(Blender().load(folder, SceneOptions()))
    assert scene.bounds.space == "contracted"
    assert scene.background.tolist() == [0, 0, 0]


def test_digest_follows_the_pixels(folder: Path) -> None:
    before = Blender().load(folder, SceneOptions())
    assert before.digest("test") == Blender().load(folder, SceneOptions()).digest("test")
    picture = ring(14, focal=(FOCAL, FOCAL), centre=(80.0, 60.0))[10].picture(with_alpha=True)
    picture[5, 5] = (1, 0, 0, 255)
    save(picture, folder / "test" / "r_0.png")
    after = Blender().load(folder, SceneOptions())
    assert before.digest("test") != after.digest("test")
    assert before.digest("train") == after.digest("train")


def test_no_test_split_is_a_sentence(folder: Path) -> None:
    (folder / "transforms_test.json").unlink()
    with pytest.raises(InputError, match=r"transforms_test\.json does not exist"):
        Blender().load(folder, SceneOptions())


def test_unequal_shapes_are_a_sentence(folder: Path) -> None:
    save(np.zeros((80, 60, 4), np.uint8), folder / "train" / "r_1.png")
    with pytest.raises(InputError, match=r"r_1\.png has 60x80 pixels and r_0\.png 160x120: one angle of view cannot"):
        Blender().load(folder, SceneOptions())


@pytest.mark.data
def test_mic(data) -> None:
    scene = validate(Blender().load(data("nerf_synthetic_mic"), SceneOptions(size=200, train_views=12)))
    assert [len(scene.train), len(scene.test)] == [12, 16]
    assert scene.notes["train_views"].startswith("12 of 100")
    assert scene.notes["test_views"].startswith("16 of 200")
    assert scene.train[0].image.shape == (200, 200, 3)
    assert inside_silhouettes(scene.train) > 0.9, "the microphone stands on its foot, within the box"


def inside_silhouettes(views) -> float:
    """How much of the silhouettes the visual hull, carved within the scene's box, fills again: 1 if all of it is inside."""
    line = torch.linspace(-1.5, 1.5, 51)
    cells = torch.cartesian_prod(line, line, line)
    kept = torch.ones(len(cells), dtype=torch.bool)
    for view in views:
        opaque = torch.nn.functional.max_pool2d(view.opacity()[None, None], 5, 1, 2)[0, 0] > 0
        pixels, z = view.camera.project(cells)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < 200).all(1)
        x, y = pixels[inside].long().T
        kept[inside.nonzero()[:, 0]] &= opaque[y, x]
    filled = []
    for view in views:
        pixels, z = view.camera.project(cells[kept])
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < 200).all(1)
        x, y = pixels[inside].long().T
        hull = torch.zeros(200, 200)
        hull[y, x] = 1
        hull = torch.nn.functional.max_pool2d(hull[None, None], 5, 1, 2)[0, 0]
        opaque = view.opacity() > 0.5
        filled.append(float(hull[opaque].mean()))
    return float(np.mean(filled))
