"""LLFF's ``poses_bounds.npy``."""

from pathlib import Path

import numpy as np
import pytest
import torch
from dots import Eye, assert_dots_are_found, ring, save

from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.llff import Llff
from invgraphics.scenes.open import validate


def forward_facing(count: int = 9) -> list[Eye]:
    """Parallel cameras on a small plane, looking along world +y with +z up."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    positions = [np.array([0.3 * (i % 3 - 1), -4.0, 0.3 * (i // 3 - 1)]) for i in range(count)]
    return [Eye(rotation, -rotation @ position, (150.0, 150.0), (80.0, 60.0)) for position in positions]


def rows(eyes: list[Eye]) -> np.ndarray:
    table = []
    for eye in eyes:
        right, down, forward = eye.R
        position = -eye.R.T @ eye.t
        hwf = np.array([eye.size[1], eye.size[0], eye.focal[0]])
        matrix = np.stack([down, right, -forward, position, hwf], axis=1)
        table.append([*matrix.ravel(), 2.0, 20.0])
    return np.array(table)


def write(path: Path, eyes: list[Eye], folder: str = "images") -> Path:
    for index, eye in enumerate(eyes):
        save(eye.picture(), path / folder / f"IMG_{index:02}.png")
    np.save(path / "poses_bounds.npy", rows(eyes))
    return path


@pytest.mark.parametrize("eyes", [forward_facing(), ring(9, focal=(150.0, 150.0), centre=(80.0, 60.0))])
def test_dots_are_where_the_cameras_say(tmp_path: Path, eyes: list[Eye]) -> None:
    scene = validate(Llff().load(write(tmp_path, eyes), SceneOptions()))
    assert [view.name for view in scene.test] == ["IMG_00.png", "IMG_08.png"]
    assert_dots_are_found(scene)


def test_the_file_may_be_named_instead_of_its_folder(tmp_path: Path) -> None:
    path = write(tmp_path, forward_facing())
    assert Llff().matches(path / "poses_bounds.npy") and Llff().matches(path) and not Llff().matches(path / "images")
    by_file, by_folder = (Llff().load(place, SceneOptions()) for place in (path / "poses_bounds.npy", path))
    assert by_file.name == by_folder.name and by_file.digest("train") == by_folder.digest("train")


def test_parallel_cameras_focus_between_the_bounds(tmp_path: Path) -> None:
    """The subject is on the middle axis, at the distance that LLFF's rule gives; up is +z; near is 10% before the bound."""
    scene = Llff().load(write(tmp_path, forward_facing()), SceneOptions())
    distance = 1 / (0.25 / (0.9 * 2) + 0.75 / (5 * 20))
    origin = scene.world_from_local[:3, 3]
    np.testing.assert_allclose(origin.numpy(), [0, -4 + distance, 0], atol=1e-5)
    corner = np.hypot(distance, 0.3 * 2**0.5)
    assert scene.scale == pytest.approx(corner, rel=1e-5)
    assert scene.bounds.near == pytest.approx(1.8 / corner, rel=1e-5)
    np.testing.assert_allclose(scene.world_from_local[:3, :3].numpy() / scene.scale, np.eye(3), atol=1e-6)
    assert scene.bounds.space == "contracted"


def test_scaled_pictures_are_enough(tmp_path: Path) -> None:
    """Poses say 160x120, the folder has only ``images_2``."""
    eyes = forward_facing()
    write(tmp_path, eyes, "unused")
    for index, eye in enumerate(eyes):
        half = Eye(eye.R, eye.t, (75.0, 75.0), (40.0, 30.0), (80, 60))
        save(half.picture(), tmp_path / "images_2" / f"IMG_{index:02}.png")
    scene = Llff().load(tmp_path, SceneOptions())
    assert scene.train[0].camera.focal.tolist() == [75.0, 75.0]
    assert torch.equal(scene.train[0].camera.principal_point, torch.tensor([40.0, 30.0]))


def test_bad_input_is_a_sentence(tmp_path: Path) -> None:
    path = write(tmp_path, forward_facing())

    def expect(sentence: str, table: np.ndarray) -> None:
        np.save(path / "poses_bounds.npy", table)
        with pytest.raises(InputError, match=sentence):
            Llff().load(path, SceneOptions())

    good = rows(forward_facing())
    expect("9 pictures, .* has 8 poses", good[:8])
    expect(r"shape \(9, 16\), expected n rows of 17 numbers", good[:, :16])
    broken = good.copy()
    broken[3, 0] = np.nan
    expect("pose of .*row 3 has entries that are not finite", broken)
    broken = good.copy()
    broken[0, 15] = -1
    expect("depth bounds of .* not positive", broken)
    broken = good.copy()
    broken[:, 14] = 0
    expect("focal length of .*row 0 are 120, 160 and 0", broken)
    expect(r"shape \(2,\)", np.array([{}, {}], dtype=object).astype(str))
    (path / "poses_bounds.npy").write_bytes(b"junk")
    with pytest.raises(InputError, match="cannot be read"):
        Llff().load(path, SceneOptions())
    (path / "images").rename(path / "photos")
    np.save(path / "poses_bounds.npy", good)
    with pytest.raises(InputError, match="no pictures"):
        Llff().load(path, SceneOptions())
