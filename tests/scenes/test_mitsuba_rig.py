"""Camera rigs: where they stand, what they look at, and that splits never share a camera."""

import math
from itertools import combinations

import pytest
import torch

from invgraphics.errors import InputError
from invgraphics.scenes.mitsuba.rig import SPLITS, _low_discrepancy, _shifts, cameras, make_rig
from invgraphics.scenes.mitsuba.spec import description_path, names, read

TABLES = {
    "sphere": {"kind": "sphere", "radius": 3.0},
    "hemisphere": {"kind": "hemisphere", "radius": 2.0, "elevation": [10.0, 60.0], "target": [0.1, 0.2, 0.3]},
    "forward": {"kind": "forward", "eye": [0.0, -3.0, 0.5]},
    "inside_out": {"kind": "inside_out", "extent": [0.4, 0.3, 0.2]},
}


@pytest.mark.parametrize("kind", TABLES)
@pytest.mark.parametrize("seed", [0, 1, 7])
def test_splits_share_no_camera(kind, seed):
    rig = make_rig(TABLES[kind])
    poses = {split: torch.stack([c.cam_to_world for c in cameras(rig, split, 100, (32, 32), seed)]) for split in SPLITS}
    for first, second in combinations(SPLITS, 2):
        difference = (poses[first][:, None] - poses[second][None]).flatten(2).norm(dim=2)
        assert difference.min() > 1e-3


@pytest.mark.parametrize("dimensions", [2, 5])
def test_no_split_runs_beside_the_training_cameras(dimensions):
    """Of one sequence and a random shift, a seed in three had every test camera within a third of the usual spacing of a
    training camera, some within a thirteenth."""
    first = _low_discrepancy(200, torch.zeros(dimensions, dtype=torch.float64))
    spacing = torch.cdist(first, first).fill_diagonal_(9).min()
    for seed in range(120):
        train, *others = (_low_discrepancy(40, shift) for shift in _shifts(dimensions, seed))
        for other in others:
            apart = (train[:, None] - other[None]).abs()
            assert float(torch.minimum(apart, 1 - apart).norm(dim=2).min()) > 0.3 * float(spacing)
    assert torch.equal(
        _shifts(dimensions, 0), torch.rand(3, dimensions, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )


@pytest.mark.parametrize("kind", TABLES)
def test_poses_are_rigid_upright_and_nested(kind):
    rig = make_rig(TABLES[kind])
    views = cameras(rig, "train", 30, (40, 30), 3)
    for camera, shorter in zip(views, cameras(rig, "train", 10, (40, 30), 3), strict=False):
        assert torch.equal(camera.cam_to_world, shorter.cam_to_world)
    for camera in views:
        rotation = camera.cam_to_world[:3, :3]
        assert torch.allclose(rotation.T @ rotation, torch.eye(3, dtype=torch.float64), atol=1e-12)
        assert torch.linalg.det(rotation) > 0
        assert rotation[2, 0].abs() < 1e-12  # the image's x axis is horizontal
        assert rotation[2, 1] < 0  # +y points down
        assert camera.principal_point.tolist() == [20, 15]
        half_fov = math.atan(15 / float(camera.focal[0]))  # across the shorter side
        assert math.degrees(2 * half_fov) == pytest.approx(rig.fov)


@pytest.mark.parametrize("kind", ["sphere", "hemisphere", "forward"])
def test_cameras_look_at_the_target(kind):
    rig = make_rig(TABLES[kind])
    for camera in cameras(rig, "test", 20, (40, 30), 0):
        pixel, depth = camera.project(torch.tensor([rig.target], dtype=torch.float64))
        assert torch.allclose(pixel[0], camera.principal_point)
        assert depth > 0


def test_a_window_above_the_scene_looks_down():
    """Along the world's up, where another axis is taken as the picture's."""
    rig = make_rig({"kind": "forward", "eye": [0.0, 0.0, 3.0]})
    views = cameras(rig, "train", 20, (40, 30), 0)
    for camera in views:
        rotation = camera.cam_to_world[:3, :3]
        assert torch.allclose(rotation.T @ rotation, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert torch.stack([camera.position for camera in views]).std(dim=0)[:2].min() > 0.1
    with pytest.raises(InputError, match="the same point"):
        make_rig({"kind": "forward", "eye": [0.0, 0.0, 0.0]})


def test_hemisphere_is_uniform_over_its_zone():
    rig = make_rig(TABLES["hemisphere"])
    offset = torch.stack([c.position for c in cameras(rig, "train", 400, (8, 8), 0)]) - torch.tensor(rig.target)
    assert torch.allclose(offset.norm(dim=1), torch.tensor(2.0, dtype=torch.float64))
    height = offset[:, 2] / 2
    low, high = math.sin(math.radians(10)), math.sin(math.radians(60))
    assert height.min() >= low
    assert height.max() <= high
    assert float(height.mean()) == pytest.approx((low + high) / 2, abs=0.01)  # Archimedes: equal heights, equal areas
    assert offset[:, :2].mean(dim=0).norm() < 0.02


def test_inside_out_steps_back_and_stays_in_its_box():
    rig = make_rig({"kind": "inside_out", "extent": [0.4, 0.3, 0.2], "setback": 0.5, "elevation": [-20, 10]})
    for camera in cameras(rig, "train", 50, (8, 8), 0):
        forward = camera.cam_to_world[:3, 2]
        level = torch.tensor([*(forward[:2] / forward[:2].norm()), 0.0], dtype=torch.float64)
        assert ((camera.position + 0.5 * level).abs() <= torch.tensor([0.4, 0.3, 0.2])).all()
        assert -20 <= math.degrees(math.asin(float(forward[2]))) <= 10


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ({"kind": "spiral"}, "hemisphere"),
        ({}, "hemisphere"),
        ({"kind": "sphere"}, "radius"),
        ({"kind": "sphere", "radius": 1.0, "colour": 3}, "colour"),
        ({"kind": "sphere", "radius": -1.0}, "radius"),
        ({"kind": "sphere", "radius": 1.0, "fov": 190.0}, "fov"),
        ({"kind": "sphere", "radius": 1.0, "elevation": [50.0, 10.0]}, "elevation"),
    ],
)
def test_wrong_rigs_are_refused(table, word):
    with pytest.raises(InputError, match=word):
        make_rig(table)


def test_built_in_scenes_describe_themselves():
    assert set(names()) >= {"bricks", "cloud", "fence", "materials", "room", "shelf", "textured"}
    for name in names():
        spec = read(description_path(name))
        assert spec.name == name
        assert spec.summary.endswith(".")
        assert spec.stresses.endswith(".")
        make_rig(spec.rig)


def test_unknown_scene_lists_the_known_ones():
    with pytest.raises(InputError, match="bricks") as caught:
        description_path("brikcs")
    assert "brikcs" in caught.value.sentence


@pytest.mark.parametrize("text", ["name = ", 'name = "x"', 'name = "x"\ncolour = 1', "\xff"])
def test_broken_descriptions_are_refused_by_name(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"scene\.toml"):
        read(path)
