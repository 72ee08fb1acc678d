"""Captures as people have them: files of other programs beside ours, renamed and removed pictures, masks of every kind."""

from pathlib import Path

import numpy as np
import pytest
import test_colmap_loader
import test_idr_loader
import test_llff_loader
import test_nerfstudio_loader
from dots import assert_dots_are_found, ring, save
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.scenes import npz
from invgraphics.scenes.colmap import Colmap
from invgraphics.scenes.idr import Idr
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba.spec import SceneSpec
from invgraphics.scenes.nerfstudio import Nerfstudio
from invgraphics.scenes.open import find_loader, validate
from invgraphics.scenes.pictures.images import Photo
from invgraphics.scenes.pictures.masks import brightness, with_masks_beside


def test_a_colmap_model_beside_llffs_poses_is_taken_for_its_lenses_and_points(tmp_path: Path) -> None:
    eyes = test_llff_loader.forward_facing()
    test_llff_loader.write(tmp_path, eyes)
    assert type(find_loader(tmp_path)).__name__ == "Llff"
    test_colmap_loader.write(tmp_path, eyes, ["PINHOLE 160 120 150 150 80 60"] * len(eyes))
    assert type(find_loader(tmp_path)).__name__ == "Colmap"
    assert type(find_loader(tmp_path / "poses_bounds.npy")).__name__ == "Llff"


def test_a_frame_may_say_itself_that_its_lens_is_a_fisheye(tmp_path: Path) -> None:
    test_nerfstudio_loader.write(tmp_path, ring(distortion=test_nerfstudio_loader.fisheye), {"camera_model": None, "k1": 0.05})

    def mark(table: dict) -> None:
        for frame in table["frames"]:
            frame["is_fisheye"] = True

    test_nerfstudio_loader.edit(tmp_path, mark)
    assert_dots_are_found(validate(Nerfstudio().load(tmp_path, SceneOptions())))


def test_pictures_keep_the_cameras_of_their_numbers_when_others_are_removed(tmp_path: Path) -> None:
    test_idr_loader.write(tmp_path, ring(9))
    for kind, name in (("image", "000003"), ("mask", "003")):
        (tmp_path / kind / f"{name}.png").unlink()
    scene = validate(Idr().load(tmp_path, SceneOptions()))
    assert len(scene.train) + len(scene.test) == 8
    assert_dots_are_found(scene)
    for path in (tmp_path / "image").iterdir():
        path.rename(path.with_name(f"view{path.name}"))
    with pytest.raises(InputError, match="has 9 cameras, and there are 8 pictures"):
        Idr().load(tmp_path, SceneOptions())


def test_images_without_lines_of_points_are_refused(tmp_path: Path) -> None:
    """COLMAP takes every second line for points, and would lose every second photograph."""
    test_colmap_loader.mixed(tmp_path)
    text = tmp_path / "sparse" / "0" / "images.txt"
    text.write_text("\n".join(line for line in text.read_text().splitlines() if line) + "\n")
    with pytest.raises(InputError, match=r"has no line of points after each image: '01\.png' follows"):
        Colmap().load(tmp_path, SceneOptions())


@pytest.mark.parametrize("change", ["\n{}", "  # made by hand\n{}", "{}\n\n"])
def test_blank_lines_and_comments_between_images_are_colmaps(tmp_path: Path, change: str) -> None:
    test_colmap_loader.mixed(tmp_path)
    text = tmp_path / "sparse" / "0" / "images.txt"
    text.write_text(change.format(text.read_text()))
    scene = Colmap().load(tmp_path, SceneOptions())
    assert len(scene.train) + len(scene.test) == 9


def test_llff_is_taken_where_the_models_photographs_are_not(tmp_path: Path) -> None:
    eyes = test_llff_loader.forward_facing()
    test_colmap_loader.write(tmp_path, eyes, ["PINHOLE 160 120 150 150 80 60"] * len(eyes))
    test_llff_loader.write(tmp_path, eyes)
    for path in (tmp_path / "images").glob("??.png"):
        path.unlink()
    assert type(find_loader(tmp_path)).__name__ == "Llff"


def test_faint_alpha_stays_faint(tmp_path: Path) -> None:
    """Only where no view has more than 1 are 0 and 1 meant."""
    alpha = np.zeros((2, 4, 4), np.uint8)
    alpha[0, 0, 0] = 1
    poses = np.tile(np.eye(4), (2, 1, 1))
    for largest, expected in ((0, 255), (255, 1)):
        alpha[1] = largest
        path = tmp_path / f"{largest}.npz"
        np.savez(path, images=np.zeros((2, 4, 4, 3), np.uint8), cam_to_world=poses, focal=np.array(4.0), alpha=alpha)
        assert npz._pixels(npz._read(path), 0, path)[0, 0, 3] == expected


def test_masks_of_every_kind_have_one_brightness() -> None:
    shape = np.array([[0, 1], [1, 0]], np.uint8)
    expected = 255 * shape
    grey = np.repeat(expected[:, :, None], 3, axis=2)
    cut_out = np.concatenate([np.full((2, 2, 3), 255, np.uint8), expected[:, :, None]], axis=2)
    opaque = np.concatenate([grey, np.full((2, 2, 1), 255, np.uint8)], axis=2)
    for mask in (grey, grey // 255, cut_out, opaque, shape[:, :, None]):
        assert brightness(mask).tolist() == expected.tolist()
    assert brightness(np.zeros((2, 2, 3), np.uint8)).max() == 0


def test_alpha_of_zeros_and_ones_is_coverage(tmp_path: Path) -> None:
    test_idr_loader.write(tmp_path, ring(3))
    found = []
    for white in (255, 1):
        for path in (tmp_path / "mask").iterdir():
            save((np.asarray(Image.open(path)) > 0) * np.uint8(white), path)
        found.append(Idr().load(tmp_path, SceneOptions()))
    assert found[0].digest("train") == found[1].digest("train")


def test_a_folder_of_masks_that_fits_no_photograph_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "images").mkdir()
    save(np.full((4, 4), 255, np.uint8), tmp_path / "masks" / "other.png")
    scene = Nerfstudio().load(test_nerfstudio_loader.write(tmp_path / "data", ring(2), {}), SceneOptions())
    photos = [Photo(tmp_path / "images" / "a.jpg", scene.train[0].camera, "a.jpg")]
    assert with_masks_beside(photos, tmp_path / "images")[0].mask is None
    assert "masks has no mask of any photograph: expected a.jpg.png." in capsys.readouterr().err


@pytest.mark.parametrize("name", ["indoor/kitchen", "../out", "", " ", "..", "a\\b", "c:d", "line\nbreak"])
def test_names_of_scenes_are_names_of_folders(name: str) -> None:
    with pytest.raises(ValueError, match="'name' must be a word"):
        SceneSpec(name, "bricks", "A toy.", "Nothing.", (-1, -1, -1), (1, 1, 2), {"kind": "sphere", "radius": 2.0})
