"""Finding the right loader, and the checks that every scene passes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics import plugins
from invgraphics.core import Bounds, Camera, Scene, View
from invgraphics.errors import InputError
from invgraphics.scenes import mitsuba
from invgraphics.scenes.layout import evenly
from invgraphics.scenes.open import SceneOptions, find_loader, open_scene, validate
from invgraphics.scenes.poses import RIGID, pose, poses
from invgraphics.scenes.region import contracted_frame


def view(index: int) -> View:
    pose = torch.eye(4)
    pose[0, 3] = index
    camera = Camera(pose, torch.tensor([10.0, 10.0]), torch.tensor([4.0, 3.0]), 8, 6)
    return View(camera, torch.zeros(6, 8, 3, dtype=torch.uint8), f"v{index}")


def scene() -> Scene:
    one = torch.ones(3)
    return Scene("toy", (view(0), view(1)), (view(2),), one, Bounds(-one, one), val=(view(3),))


def test_good_scene_passes() -> None:
    good = scene()
    assert validate(good) is good


def _posed(change) -> View:
    bad = view(1)
    pose = bad.camera.cam_to_world.clone()
    change(pose)
    return replace(bad, camera=bad.camera.moved(pose))


def _lens(**values: object) -> View:
    return replace(view(1), camera=replace(view(1).camera, **values))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"train": ()}, "has no train views"),
        ({"test": ()}, "has no test views"),
        (
            {"train": (view(0), _posed(lambda p: p[0].fill_(torch.nan)))},
            "train view 'v1' of 'toy' has entries that are not finite",
        ),
        ({"train": (view(0), _posed(lambda p: p[:3, :3].mul_(2)))}, "train view 'v1' of 'toy' is not rigid"),
        ({"test": (_posed(lambda p: p[2, 2].fill_(-1)),)}, "test view 'v1' of 'toy' is left-handed"),
        ({"train": (_lens(focal=torch.tensor([0.0, 1.0])),)}, "train view 'v1' .* has focal length"),
        ({"train": (_lens(principal_point=torch.tensor([torch.inf, 1.0])),)}, "train view 'v1' .* principal point"),
        ({"train": (_lens(width=9),)}, "image of train view 'v1' of 'toy' has 8x6 pixels, its camera 9x6"),
        ({"val": (replace(view(4), image=torch.full((6, 8, 3), torch.nan)),)}, "image of val view 'v4' .* not finite"),
        ({"val": (replace(view(4), depth=torch.full((6, 8), torch.nan)),)}, "depth of val view 'v4' .* not finite"),
        ({"val": (replace(view(4), image=torch.full((6, 8, 3), 200.0)),)}, "image of val view 'v4' .* values from 200 to 200"),
        ({"val": (replace(view(4), image=torch.full((6, 8, 3), -0.1)),)}, "image of val view 'v4' .* values from -0.1"),
        ({"val": (replace(view(4), alpha=torch.full((6, 8), 1.1)),)}, "alpha of val view 'v4' .* values from 1.1"),
        ({"val": (replace(view(4), image=torch.zeros(6, 8, 4)),)}, "image of val view 'v4' .* shape .6, 8, 4.; expected"),
        ({"val": (replace(view(4), image=np.zeros((6, 8, 3), np.uint8)),)}, "image of val view 'v4' .* is a ndarray, not a"),
        ({"val": (replace(view(4), mask=torch.ones(6, 8)),)}, "mask of val view 'v4' .* is torch.float32"),
        ({"train": (replace(view(0), mask=torch.zeros(6, 8, dtype=torch.bool)),)}, "masks of 'toy' leave no pixel"),
        ({"train": (_lens(width=8.0),)}, "width of the camera of train view 'v1' .* is 8.0"),
        ({"test": (view(2), view(1))}, "train view 'v1' and the test view 'v1' of 'toy' share a camera"),
    ],
)
def test_bad_scenes_are_refused(change: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        validate(scene().with_views(**change))


def test_double_precision_becomes_single() -> None:
    """As NumPy's arrays are; 8-bit pictures stay what they are."""
    plain = scene()
    floats = replace(view(0), image=torch.full((6, 8, 3), 0.25).double(), camera=view(0).camera.to(torch.float64))
    one = torch.ones(3, dtype=torch.float64)
    made = validate(replace(plain, train=(floats, view(1)), background=one, bounds=Bounds(-one, one)))
    first, second = made.train
    tensors = (first.image, first.camera.cam_to_world, first.camera.focal, made.background, made.bounds.lo, made.bounds.hi)
    assert {values.dtype for values in tensors} == {torch.float32}
    assert second.image.dtype == torch.uint8
    assert float(first.image.max()) == 0.25
    assert validate(replace(plain, colour="linear", val=(replace(view(4), image=torch.full((6, 8, 3), 7.0)),))).val


def test_infinite_depth_is_allowed() -> None:
    validate(scene().with_views(val=(replace(view(4), depth=torch.full((6, 8), torch.inf)),)))


@pytest.mark.parametrize(
    ("file", "loader"),
    [
        ("transforms_train.json", "blender"),
        ("transforms.json", "nerfstudio"),
        ("poses_bounds.npy", "llff"),
        ("sparse/0/cameras.bin", "colmap"),
        ("cameras_sphere.npz", "idr"),
    ],
)
def test_format_is_recognised(tmp_path: Path, file: str, loader: str) -> None:
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    assert type(find_loader(tmp_path)).__name__.lower() == loader


def test_unknown_formats_are_sentences(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is an empty folder\.\nLooked for .*transforms_train\.json.*formats: truth, blender"):
        open_scene(str(tmp_path))
    (tmp_path / "readme.txt").touch()
    with pytest.raises(InputError, match="is not a data set of a known format"):
        open_scene(str(tmp_path))
    with pytest.raises(InputError, match="is not a data set of a known format"):
        open_scene(str(tmp_path / "readme.txt"))


def test_photographs_without_poses_are_sent_to_import_photos(tmp_path: Path) -> None:
    (tmp_path / "IMG_1.JPG").touch()
    with pytest.raises(InputError, match=r"holds photographs without poses\.\nRun `invgraphics import-photos "):
        open_scene(str(tmp_path))


def test_unknown_name_lists_the_built_in_scenes() -> None:
    with pytest.raises(InputError, match=r"'brick' is neither .* path\. Did you mean 'bricks'\?\n.*bricks"):
        open_scene("brick")


@pytest.mark.parametrize(("size", "expected"), [(None, None), ((32, 16), (32, 16)), (48, (48, 48))])
def test_built_in_scenes_are_rendered_then_loaded(tmp_path: Path, monkeypatch, size, expected) -> None:
    calls = {}

    def make(name: str, **options: object) -> Path:
        calls[name] = options
        return tmp_path

    class Truth:
        def load(self, path: Path, options: SceneOptions) -> Scene:
            calls["loaded"] = (path, options)
            return scene()

    monkeypatch.setattr(mitsuba, "make", make)
    monkeypatch.setattr(plugins, "load", lambda registry, name: Truth)
    options = SceneOptions(size=size, test_views=3, seed=5, spp=7)
    opened = open_scene("bricks", options, progress=print)
    assert opened.name == "toy"
    assert calls["bricks"] == {"size": expected, "train": None, "test": 3, "spp": 7, "seed": 5, "progress": print}
    assert calls["loaded"] == (tmp_path, options)


def test_samples_are_for_what_is_rendered(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").touch()
    with pytest.raises(InputError, match=r"holds pictures, whose samples per pixel are what they are\.\nLeave out --spp"):
        open_scene(str(tmp_path), SceneOptions(spp=64))


def test_evenly_spaced_choice() -> None:
    assert evenly(list(range(200)), 4) == [25, 75, 125, 175]
    assert evenly(list(range(3)), 16) == [0, 1, 2]
    assert evenly(list(range(3)), None) == [0, 1, 2]
    assert len(set(evenly(list(range(17)), 16))) == 16


@pytest.mark.parametrize("bad", [{"size": 0}, {"size": (4, -1)}, {"test_views": 0}, {"train_views": -2}, {"spp": 0}])
def test_bad_options_are_refused(bad: dict) -> None:
    with pytest.raises(InputError):
        SceneOptions(**bad)


def test_inside_out_rig_is_centred_on_its_cameras() -> None:
    """Axes that diverge meet behind the cameras: the middle of the cameras is the better origin."""
    poses = []
    for angle in (0.0, 0.4, 1.0, 2.0, 3.5):
        forward = np.array([np.cos(angle), np.sin(angle), 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(forward, [0, 0, 1]), [0, 0, -1], forward], axis=1)
        pose[:3, 3] = 0.5 * forward + [3, 0, 1]  # all axes meet at (3, 0, 1)
        poses.append(pose)
    positions = np.stack(poses)[:, :3, 3]
    middle = positions.mean(0)
    radius = np.linalg.norm(positions - middle, axis=1).max()
    expected = np.block([[radius * np.eye(3), middle[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    frame = contracted_frame(torch.from_numpy(np.stack(poses)))
    np.testing.assert_allclose(frame.world_from_local.numpy(), expected, atol=1e-9)


def test_upside_down_world_is_righted() -> None:
    pose = torch.diag(torch.tensor([1.0, 1, 1, 1], dtype=torch.float64))
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # image down is world +z
    frame = contracted_frame(pose[None])
    up = frame.world_from_local[:3, 2] / frame.world_from_local[:3, 2].norm()
    np.testing.assert_allclose(up.numpy(), [0, 0, -1], atol=1e-9)
    assert float(torch.linalg.det(frame.world_from_local[:3, :3])) > 0


def test_plug_in_formats_are_asked_too(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "mine.json").write_text(json.dumps({}))

    class Mine:
        def matches(self, path: Path) -> bool:
            return (path / "mine.json").is_file()

        def load(self, path: Path, options: SceneOptions) -> Scene:
            return scene()

    monkeypatch.setattr("invgraphics.plugins.registered._REGISTERED", {})
    plugins.register("scenes", "mine", Mine)
    assert open_scene(str(tmp_path)).name == "toy"


def test_poses_of_a_class_are_made_rigid_as_each_alone_is() -> None:
    generator = torch.Generator().manual_seed(0)
    turned = torch.linalg.qr(torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)).Q
    turned *= torch.linalg.det(turned)[:, None, None]
    off = turned + 0.2 * RIGID * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    matrices = torch.cat([off, torch.randn(5, 3, 1, generator=generator, dtype=torch.float64)], dim=2)
    found = poses(matrices, str)
    assert torch.allclose(found, torch.stack([pose(matrix, "") for matrix in matrices]), atol=1e-12)
    assert torch.allclose(found[:, :3, :3].mT @ found[:, :3, :3], torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    for bad, words in ((matrices[3] * 2, "not rigid"), (matrices[3] * torch.tensor([1, 1, -1, 1]), "left-handed")):
        with pytest.raises(InputError, match=f"pose of view 3 is {words}"):
            poses(torch.cat([matrices[:3], bad[None], matrices[4:]]), "view {}".format)


def test_test_views_are_not_watched_too() -> None:
    """Data sets with one list for both: what is scored stays, what is only looked at goes."""
    found = validate(scene().with_views(test=(view(2), view(3)), val=(view(3), view(4))))
    assert [one.name for one in found.test] == ["v2", "v3"]
    assert [one.name for one in found.val] == ["v4"]
    assert found.notes["val_views"] == "1 that are test views, too, are left out"


def test_a_principal_point_far_outside_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    validate(scene())
    assert capsys.readouterr().err == ""
    validate(scene().with_views(train=(view(0), _lens(principal_point=torch.tensor([40.0, 3.0])))))
    assert "Warning: 'v1' has its principal point far outside the picture" in capsys.readouterr().err


def test_the_name_of_a_real_data_set_is_answered_with_its_path(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "fox").mkdir()
    monkeypatch.setenv("INVGRAPHICS_DATA", str(tmp_path))
    with pytest.raises(InputError, match=r"Did you mean '\$INVGRAPHICS_DATA/fox'\?"):
        open_scene("fox")
    with pytest.raises(InputError) as refused:
        open_scene("atlantis")
    assert "Did you mean" not in str(refused.value)
