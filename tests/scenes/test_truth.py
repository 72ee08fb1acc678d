"""The loader of rendered scenes, on a folder written without Mitsuba."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics.core import Bounds
from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba import folder as folders
from invgraphics.scenes.mitsuba import ply
from invgraphics.scenes.mitsuba.build.mesh import box
from invgraphics.scenes.mitsuba.gbuffer import GBuffer
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.rig import cameras, make_rig
from invgraphics.scenes.mitsuba.spec import Counts, SamplesPerPixel, SceneSpec
from invgraphics.scenes.truth import Truth

W, H = 12, 8
RIG = {"kind": "sphere", "radius": 2.0}


def _write(folder: Path, *, opaque: bool = False, surface: bool = True, radius: float = 2.0, points: int = 5) -> Path:
    rig = {**RIG, "radius": radius}
    background = None if opaque else (1.0, 0.5, 0.25)
    spec = SceneSpec("toy", "bricks", "A toy.", "Nothing.", (-1, -1, -1), (1, 1, 2), rig, background=background)
    job = Job(spec, (W, H), Counts(3, 1, 4), SamplesPerPixel(4, 2, 8), 0, "scalar_rgb")
    rng = np.random.default_rng(0)
    views = {}
    for split, count in (("train", 3), ("val", 1), ("test", 4)):
        views[split] = cameras(make_rig(rig), split, count, (W, H), 0)
        for index in range(count):
            alpha = np.ones((H, W, 1)) if opaque else rng.random((H, W, 1)).round()
            linear = np.concatenate([rng.random((H, W, 3)) * alpha, alpha], axis=2).astype(np.float32)
            depth = np.where(alpha[..., 0] > 0, 1.5 + index, np.inf).astype(np.float32)
            depth = depth if surface else np.full((H, W), np.inf, np.float32)
            normal = np.where(np.isfinite(depth)[..., None], [0, 0, 1], 0).astype(np.float32)
            gbuffer = GBuffer(depth, normal, alpha[..., 0].astype(np.float32), np.zeros((H, W, 3)))
            folders.write_view(folder, split, index, linear, gbuffer, 40.0 + index)
        folders.write_transforms(folder, split, views[split])
    if surface:
        cube = box((0, 0, 0), (1, 1, 1))
        ply.write(folder / "mesh.ply", cube.vertices, cube.faces)
        np.savez(folder / "points.npz", position=np.zeros((points, 3), np.float32), rgb=np.ones((points, 3), np.float32))
    folders.write_truth(folder, job, views, [40.0, 41.0, 42.0, 43.0])
    return folder


def test_loads_what_was_written(tmp_path):
    folder = _write(tmp_path)
    assert Truth().matches(folder)
    scene = Truth().load(folder, SceneOptions(test_views=None))
    assert (scene.name, len(scene.train), len(scene.val), len(scene.test)) == ("toy", 3, 1, 4)
    assert scene.background.tolist() == [1.0, 0.5, 0.25]
    assert (scene.bounds.lo.tolist(), scene.bounds.hi.tolist()) == ([-1, -1, -1], [1, 1, 2])
    assert scene.noise_ceiling == pytest.approx(41.5)
    assert scene.points is not None
    assert len(scene.points) == 5
    assert scene.mesh is not None
    assert scene.mesh.faces.shape == (12, 3)
    assert torch.equal(scene.world_from_local, torch.eye(4))
    view = scene.test[2]
    expected = cameras(make_rig(RIG), "test", 4, (W, H), 0)[2]
    assert torch.allclose(view.camera.cam_to_world, expected.cam_to_world.float())
    assert view.camera.focal.dtype == torch.float32
    assert view.alpha is not None
    assert view.depth is not None
    assert torch.equal(view.depth.isfinite(), view.alpha == 255)
    assert view.depth[view.alpha == 255].unique().tolist() == [3.5]
    assert view.normal is not None
    assert view.normal.shape == (H, W, 3)


def test_only_cameras_in_the_box_get_a_near_plane_before_the_nearest_points(tmp_path):
    """Cameras half a unit from all points have it at 0.35, also where one of them is loaded; those outside keep the default."""
    within, outside = _write(tmp_path / "within", radius=0.5, points=20), _write(tmp_path / "outside", points=20)
    for views in (None, 1):
        scene = Truth().load(within, SceneOptions(train_views=views))
        assert scene.is_interior
        assert scene.bounds.near == pytest.approx(0.7 * 0.5, rel=1e-5)
    scene = Truth().load(outside, SceneOptions())
    assert not scene.is_interior
    assert scene.bounds.near == Bounds.near


def test_opaque_scenes_have_no_alpha(tmp_path):
    scene = Truth().load(_write(tmp_path, opaque=True), SceneOptions())
    assert not scene.has_alpha
    assert all(view.alpha is None for view in scene.test)


def test_fog_has_neither_surface_nor_points(tmp_path):
    scene = Truth().load(_write(tmp_path, surface=False), SceneOptions())
    assert scene.mesh is None
    assert scene.points is None
    assert scene.test[0].depth is None
    assert scene.test[0].normal is None


def test_fewer_views_are_the_first(tmp_path):
    scene = Truth().load(_write(tmp_path), SceneOptions(test_views=2, train_views=1))
    assert [view.name for view in scene.test] == ["0000", "0001"]
    assert [view.name for view in scene.train] == ["0000"]


def test_another_size_keeps_no_geometry(tmp_path):
    scene = Truth().load(_write(tmp_path), SceneOptions(size=6))
    view = scene.test[0]
    assert (view.camera.width, view.camera.height, tuple(view.image.shape)) == (6, 4, (4, 6, 3))
    assert view.depth is None
    assert "12x8 to 6x4" in scene.notes["resize"]


def test_noise_falls_with_the_pixels_that_are_averaged(tmp_path):
    full, half = (Truth().load(_write(tmp_path), SceneOptions(size=size)).noise_ceiling for size in (None, 6))
    assert full == pytest.approx(41.5) and half == pytest.approx(41.5 + 20 * np.log10(2))  # of four independent pixels


@pytest.mark.parametrize("damage", ["json", "schema", "missing", "short", "camera"])
def test_damage_is_reported(tmp_path, damage):
    folder = _write(tmp_path)
    truth = folder / "truth.json"
    content = json.loads(truth.read_text())
    if damage == "json":
        truth.write_text("{")
    elif damage == "schema":
        truth.write_text(json.dumps(content | {"schema": 99}))
    elif damage == "missing":
        (folder / "train/0001.npz").unlink()
    elif damage == "short":
        (folder / "mesh.ply").write_bytes((folder / "mesh.ply").read_bytes()[:-4])
    else:
        del content["cameras"]["test"][0]["focal"]
        truth.write_text(json.dumps(content))
    with pytest.raises(InputError, match=str(tmp_path)):
        Truth().load(folder, SceneOptions())


def test_other_folders_do_not_match(tmp_path):
    assert not Truth().matches(tmp_path)
