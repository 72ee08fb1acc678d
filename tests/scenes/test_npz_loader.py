"""Our own one-file convention."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dots import COLOURS, POINTS, assert_dots_are_found, ring

from invgraphics.core import Bounds, View
from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.npz import Npz
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.scenes.open import open_scene, validate
from invgraphics.testing import toy_scene


def arrays(with_alpha: bool = False) -> dict[str, Any]:
    eyes = ring(9)
    return {
        "images": np.stack([eye.picture(with_alpha) for eye in eyes]),
        "cam_to_world": np.stack([eye.cam_to_world for eye in eyes]),
        "focal": np.array([150.0, 155.0]),
        "centre": np.array([83.0, 58.0]),
    }


def write(path: Path, **values: Any) -> Path:
    np.savez(path / "scene.npz", **{key: value for key, value in values.items() if value is not None})
    return path / "scene.npz"


@pytest.mark.parametrize("size", [None, 80, (100, 75)])
def test_dots_are_where_the_cameras_say(tmp_path: Path, size: Any) -> None:
    path = write(tmp_path, **arrays())
    assert Npz().matches(path)
    scene = validate(Npz().load(path, SceneOptions(size=size)))
    assert_dots_are_found(scene, within=0.3 if size is None else 0.4)
    assert [view.name for view in scene.test] == ["0", "8"]
    assert scene.bounds.space == "contracted"


@pytest.mark.parametrize("apart", [False, True])
def test_an_object_by_itself_is_in_a_box(tmp_path: Path, apart: bool) -> None:
    values = arrays(with_alpha=True)
    if apart:
        values |= {"images": values["images"][..., :3], "alpha": values["images"][..., 3]}
    scene = validate(Npz().load(write(tmp_path, **values), SceneOptions()))
    assert scene.bounds.space == "box"
    assert_dots_are_found(scene)


@pytest.mark.parametrize("most", [1, 255])
def test_bytes_of_zero_and_one_are_all_or_nothing(tmp_path: Path, most: int) -> None:
    """Unless any view has more: then a view whose alpha is 1 at most is nearly transparent."""
    values = arrays()
    alpha = np.zeros(values["images"].shape[:3], np.uint8)
    alpha[:, 20:40], alpha[1, 20:40] = most, 1
    bounds = np.array([[-1.0, -1, -1], [1, 1, 2]])
    scene = Npz().load(write(tmp_path, **values, alpha=alpha, bounds=bounds), SceneOptions())
    for view in (*scene.train, *scene.test):
        assert view.alpha is not None
        expected = (1 if most == 255 else 255) if view.name == "1" else 255
        assert view.alpha[30, 0] == expected and view.alpha[0, 0] == 0


def test_everything_optional(tmp_path: Path) -> None:
    """Alpha apart, floats, per-view lenses, own split, a box, geometry and points in the world's frame."""
    values = arrays(with_alpha=True)
    rgba = values["images"].astype(np.float64) / 255
    n = len(rgba)
    values |= {
        "images": rgba[..., :3],
        "alpha": rgba[..., 3],
        "focal": np.tile([150.0, 155.0], (n, 1)),
        "centre": np.tile([83.0, 58.0], (n, 1)),
        "cam_to_world": values["cam_to_world"][:, :3],
        "depth": np.full((n, 120, 160), 4.0),
        "normal": np.tile([0.0, 0.0, 1.0], (n, 120, 160, 1)),
        "points": POINTS,
        "points_rgb": COLOURS,
        "test": np.arange(n) > 6,
        "bounds": np.array([[-1.0, -1, -1], [1, 1, 2]]),
    }
    scene = validate(open_scene(str(write(tmp_path, **values))))
    assert_dots_are_found(scene)
    assert [view.name for view in scene.test] == ["7", "8"]
    assert scene.bounds.space == "box"
    assert scene.bounds.hi.tolist() == [1, 1, 2]
    assert scene.background.tolist() == [1, 1, 1]
    view = scene.train[0]
    assert view.depth is not None
    assert view.normal is not None
    assert float(view.depth.mean()) == 4.0
    assert scene.points is not None
    np.testing.assert_allclose(scene.points.position.numpy(), POINTS, atol=1e-6)


def test_geometry_moves_into_the_local_frame(tmp_path: Path) -> None:
    """Unbounded: depth along a ray still ends on the known point, and normals turn with the world."""
    eyes = ring(9)
    depth = np.stack([np.full((120, 160), np.linalg.norm(eye.t)) for eye in eyes])
    normal = np.stack([np.tile(-eye.R[2], (120, 160, 1)) for eye in eyes])
    path = write(tmp_path, **arrays(), depth=depth, normal=normal)
    scene = Npz().load(path, SceneOptions())
    for view in scene.train:
        assert view.depth is not None
        assert view.normal is not None
        torch.testing.assert_close(view.normal[60, 80], -view.camera.cam_to_world[:3, 2])
        # Every eye looks at the world's origin along its axis, at the distance that `depth` says.
        axis = view.camera.rays(view.camera.principal_point[None]).at(view.depth[60:61, 80])[0]
        world = scene.world_from_local[:3, :3] @ axis + scene.world_from_local[:3, 3]
        assert float(world.norm()) < 1e-5
    assert Npz().load(path, SceneOptions(size=80)).train[0].depth is None
    assert "dropped" in Npz().load(path, SceneOptions(size=80)).notes["geometry"]


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_a_kept_scene_stays_in_its_own_units(tmp_path: Path, factor: float) -> None:
    """Its box is not scaled to a usual size: cameras made for the scene are those of what was fitted to the copy."""
    toy = toy_scene(views=2, size=8)

    def larger(view: View) -> View:
        pose = view.camera.cam_to_world.clone()
        pose[:3, 3] *= factor
        return replace(view, camera=view.camera.moved(pose), depth=None)

    splits = {split: tuple(larger(view) for view in getattr(toy, split)) for split in ("train", "val", "test")}
    bounds = Bounds(toy.bounds.lo * factor, toy.bounds.hi * factor, near=toy.bounds.near)
    scene = replace(toy, **splits, bounds=bounds, points=None)
    save_npz(scene, tmp_path / "kept.npz")
    again = Npz().load(tmp_path / "kept.npz", SceneOptions(test_views=None))
    assert torch.equal(again.world_from_local, torch.eye(4))
    torch.testing.assert_close(again.bounds.hi, scene.bounds.hi)
    torch.testing.assert_close(again.train[0].camera.cam_to_world, scene.train[0].camera.cam_to_world, check_dtype=False)


@pytest.mark.parametrize(("size", "place"), [(40.0, (90.0, -200.0, 10.0)), (0.01, (0.0, 0.0, 0.0)), (1.0, (500.0, 0.0, 0.0))])
def test_a_box_of_any_size_and_place_is_scaled(tmp_path: Path, size: float, place: tuple[float, float, float]) -> None:
    values = arrays()
    poses = values["cam_to_world"].copy()
    poses[:, :3, 3] = size * poses[:, :3, 3] + place
    box = np.array([[-1.0, -1, -1], [1, 1, 2]])
    values |= {
        "cam_to_world": poses,
        "points": size * POINTS + place,
        "points_rgb": COLOURS,
        "depth": np.full((9, 120, 160), 4.0 * size),
        "bounds": size * box + np.array(place),
    }
    scene = validate(Npz().load(write(tmp_path, **values), SceneOptions()))
    assert torch.allclose(scene.bounds.hi, torch.tensor([1.0, 1, 1.5]), atol=1e-3)
    assert torch.allclose(scene.bounds.lo, -scene.bounds.hi, atol=1e-3)
    assert scene.scale == pytest.approx(size, rel=1e-3)
    assert scene.points is not None
    assert torch.allclose(scene.points.position, torch.from_numpy(POINTS - [0, 0, 0.5]).float(), atol=1e-3)
    view = scene.train[0]
    assert view.depth is not None
    assert float(view.depth.mean()) == pytest.approx(4.0, rel=1e-3)
    pixels, _ = view.camera.project(scene.points.position)
    assert np.allclose(pixels.numpy(), ring(9)[1].pixels(POINTS), atol=0.05)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"images": None, "focal": None}, "has no 'images' and no 'focal'"),
        ({"images": np.zeros((9, 4))}, r"'images' of .* has shape \(9, 4\)"),
        ({"images": np.full((9, 4, 4, 3), 7.0)}, "neither bytes nor finite floats"),
        ({"cam_to_world": np.zeros((9, 4, 4))}, "view 0 is not rigid"),
        ({"cam_to_world": np.zeros((3, 4, 4))}, r"'cam_to_world' of .* has shape \(3, 4, 4\), expected \(9, 4, 4\)"),
        ({"cam_to_world": np.full((9, 4, 4), np.inf)}, "view 0 has entries that are not finite"),
        ({"focal": np.array("wide")}, "'focal' of .* holds .*, not numbers"),
        ({"focal": np.array(-5.0)}, "has focal length"),
        ({"test": np.zeros(9, bool)}, "9 views to fit and 0 to score"),
        ({"test": np.zeros(9)}, "expected one boolean per view"),
        ({"bounds": np.zeros((2, 3))}, "the first corner must be below"),
        ({"points": np.zeros((4, 2))}, "'points' of"),
        ({"points": np.full((4, 3), np.nan)}, "not finite"),
        ({"images": np.array([None, {}], dtype=object)}, "cannot be read"),
    ],
)
def test_bad_input_is_a_sentence(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    path = write(tmp_path, **(arrays() | changes))
    with pytest.raises(InputError, match=sentence):
        validate(Npz().load(path, SceneOptions()))


def test_damaged_file_is_a_sentence(tmp_path: Path) -> None:
    path = write(tmp_path, **arrays())
    content = bytearray(path.read_bytes())
    content[20000:20400] = b"\xff" * 400
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"scene\.npz cannot be read"):
        Npz().load(path, SceneOptions())


@pytest.mark.data
def test_garden_has_no_photographs(data) -> None:
    with pytest.raises(InputError, match="has no 'images' and no 'cam_to_world'"):
        open_scene(str(data("gsplat_garden/test_garden.npz")))


def test_a_misspelt_key_is_not_ignored(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown key 'center'\. Did you mean 'centre'\?"):
        open_scene(str(write(tmp_path, **arrays(), center=np.array([80.0, 60.0]))))
