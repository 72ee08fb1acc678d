"""Sparse depth: the penalty against a loop over samples, rays through landmarks, who gets it, and the depth that it mends."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tracked_plane import SIZE, photographs, workspace
from training_fixtures import SMALL

from invgraphics.core import Bounds, Camera, Context, FieldValues, RayRenderer, Rays, Rendering, Samples, Scene, Trace, View
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_plan
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.views.sparse_depth import SparseDepth, SparseDepthConfig, make_sparse_depth

CPU = torch.device("cpu")


class Fixed(RayRenderer):
    """Three samples on each ray, at distances 1, 2 and 3, with weights that depend on the ray's view."""

    WEIGHTS = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])

    def render_rays(self, field: Any, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        n = len(rays)
        ray, middle = torch.arange(n).repeat_interleave(3), torch.tensor([1.0, 2.0, 3.0]).repeat(n)
        samples = Samples.on(rays, ray, middle - 0.5, middle + 0.5)
        none = torch.zeros(n)
        trace = Trace(rays=n, samples=samples, values=FieldValues(), weights=self.WEIGHTS[rays.view].flatten())
        return Rendering(torch.zeros(n, 3), none, none), trace


def test_the_penalty_is_that_of_a_loop_over_samples() -> None:
    """Rays whose points are at 1, 2, 3 and 4: ends far off, near by, all in one place, and none at all."""
    views, distance = [0, 0, 1, 2], torch.tensor([1.0, 2.0, 3.0, 4.0])
    expected = []
    for view, d in zip(views, distance.tolist(), strict=True):
        total, rest = 0.0, 1.0
        for weight, t in zip(Fixed.WEIGHTS[view].tolist(), (1.0, 2.0, 3.0), strict=True):
            total += weight * min(abs(t - d) / (0.5 * d), 1.0)
            rest -= weight
        expected.append(total + rest)
    ctx = Context(Bounds(-torch.ones(3), torch.ones(3)), training=True, generator=torch.Generator().manual_seed(0))
    for index, (view, value) in enumerate(zip(views, expected, strict=True)):
        rays = Rays.make(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), view=view)
        penalty = SparseDepth(SparseDepthConfig(weight=0.5, rays=4), rays, distance[index : index + 1])
        assert float(penalty(None, Fixed(), ctx)) == pytest.approx(0.5 * value, abs=1e-6)  # pyright: ignore[reportArgumentType]
    assert expected == pytest.approx([0.2 + 0.3 + 0.4, 0.1 + 0.3 + 0.4, 0.0, 1.0])


def scene_of(views: list[View]) -> Scene:
    return Scene("plane", tuple(views), (), torch.zeros(3), Bounds(-torch.full((3,), 4.0), torch.full((3,), 4.0)))


def made(scene: Scene) -> SparseDepth:
    found = make_sparse_depth(SparseDepthConfig(), scene, VolumetricConfig().build(scene))
    assert found is not None
    return found


def test_rays_go_from_their_cameras_through_the_landmarks() -> None:
    views, points, observed = photographs([1.0] * 4)
    shown = [replace(view, landmarks=points[rows]) for view, rows in zip(views, observed, strict=True)]
    found = made(scene_of(shown))
    assert len(found.rays) == sum(map(len, observed))
    ends = found.rays.origins + found.distance[:, None] * found.rays.directions
    for index, (view, rows) in enumerate(zip(views, observed, strict=True)):
        own = found.rays.view == index
        torch.testing.assert_close(ends[own], points[rows], atol=1e-5, rtol=0)
        torch.testing.assert_close(found.rays.origins[own], view.camera.position.expand(len(rows), 3))
    assert found.note == f"{len(found.rays):,} rays of 4 training photographs end at points of structure from motion"


def test_landmarks_that_no_counted_pixel_shows_are_left_out() -> None:
    """Behind the camera, beside the picture, under the mask, or outside the bounds."""
    view = photographs([1.0])[0][0]
    camera = Camera(torch.eye(4), torch.tensor([80.0, 80.0]), torch.tensor([32.0, 32.0]), SIZE, SIZE)
    points = torch.tensor([[0.1, 0.0, 2.0], [-0.1, 0.0, 2.0], [0.1, 0.0, -2.0], [5.0, 0.0, 2.0], [0.1, 0.0, 9.0]])
    view = replace(view, camera=camera, landmarks=points)
    found = made(scene_of([view]))
    assert found.distance.tolist() == pytest.approx([2.0025, 2.0025], abs=1e-4)
    mask = torch.arange(SIZE)[None, :].expand(SIZE, -1) >= SIZE // 2
    found = made(scene_of([replace(view, mask=mask)]))
    assert bool((found.rays.directions[:, 0] > 0).all())
    for without in (
        replace(view, mask=torch.zeros_like(mask)),
        replace(view, landmarks=None),
        replace(view, landmarks=points[:0]),
    ):
        with pytest.raises(InputError, match="show no known points"):
            made(scene_of([without]))


def test_a_colmap_reconstruction_tells_which_photographs_show_its_points(tmp_path: Path) -> None:
    _, points, observed = photographs([1.0] * 10)
    scene = open_scene(str(workspace(tmp_path / "plane", [1.0] * 10)), SceneOptions())
    local_from_world = torch.linalg.inv(scene.world_from_local)
    for view in scene.train:
        rows = observed[int(view.name.removesuffix(".png")) - 1]
        expected = points[rows] @ local_from_world[:3, :3].T + local_from_world[:3, 3]
        assert view.landmarks is not None
        order = [values[values[:, 0].argsort()] for values in (view.landmarks, expected)]
        torch.testing.assert_close(*order, atol=1e-5, rtol=0)
    assert all(view.landmarks is None for view in scene.test)
    count = sum(len(observed[int(view.name.removesuffix(".png")) - 1]) for view in scene.train)
    assert scene.notes["landmarks"].startswith(f"{count:,} views of points")


@pytest.mark.parametrize("changes", [{"pose_noise": 1.0}, {"pose_noise": 1.0, "init": "sfm"}, {"init": "random"}])
def test_landmarks_are_dropped_with_the_poses_or_points_they_belong_to(tmp_path: Path, changes: dict[str, Any]) -> None:
    scene = open_scene(str(workspace(tmp_path / "plane", [1.0] * 10)), SceneOptions())
    found = degrade(scene, TrainingData(**changes), 0)
    assert all(view.landmarks is None for view in found.train) and "landmarks" not in found.notes
    kept = degrade(scene, TrainingData(test_scales=(2,)), 0)
    assert all(view.landmarks is not None for view in kept.train) and "landmarks" in kept.notes


def supervised(method: str, scene: Scene, *changes: str) -> bool:
    plan = build_plan(load_method(method, overrides=list(changes)), scene, Budget(seconds=None, steps=1), 0, CPU)
    return any(isinstance(penalty, SparseDepth) for penalty in plan.penalties)


def test_volume_rendering_of_photographs_with_tracks_is_supervised(tmp_path: Path) -> None:
    scene = open_scene(str(workspace(tmp_path / "plane", [1.0] * 10)), SceneOptions())
    assert [supervised(f"volumetric/{name}", scene) for name in ("hash", "nerf", "mip-nerf-360")] == [True] * 3
    assert supervised("hybrid/neus-hash", scene)
    assert not supervised("splatting/gaussians", scene) and not supervised("learned/srn", scene)
    assert not supervised("volumetric/hash", scene, "training.sparse_depth.weight=0")
    assert supervised("volumetric/hash", scene, "training.sparse_depth.rays=7")
    boxed = replace(scene, bounds=replace(scene.bounds, space="box"))
    assert not supervised("volumetric/hash", boxed) and supervised("volumetric/hash", boxed, "training.sparse_depth.rays=7")
    assert not supervised("volumetric/hash", scene, "training.poses.optimise=true")
    assert not supervised("volumetric/hash", replace(scene, train=tuple(replace(v, landmarks=None) for v in scene.train)))
    unseen = replace(scene, train=tuple(replace(view, landmarks=None) for view in scene.train))
    for method, where, more, reason in [
        ("volumetric/hash", unseen, (), "show no known points"),
        ("splatting/gaussians", scene, (), "only volume rendering"),
        ("volumetric/hash", scene, ("training.poses.optimise=true",), "poses are optimised"),
    ]:
        with pytest.raises(InputError, match=f"training.sparse_depth cannot be used: .*{reason}"):
            supervised(method, where, "training.sparse_depth.rays=7", *more)
        assert not supervised(method, where, "training.sparse_depth.weight=0", *more)
    with pytest.raises(InputError, match="rays"):
        load_method("volumetric/hash", overrides=["training.sparse_depth.rays=0"])


class Ending(Fixed):
    """A renderer of another package that says what its traces mean."""

    ends_in_samples = True


def test_a_renderer_of_another_package_is_supervised_where_it_says_that_rays_end_in_samples(tmp_path: Path) -> None:
    scene = open_scene(str(workspace(tmp_path / "plane", [1.0] * 10)), SceneOptions())
    assert make_sparse_depth(None, scene, Ending()) is not None
    assert make_sparse_depth(None, scene, Fixed()) is None


def test_points_mend_the_depth_of_a_plane_in_few_photographs(tmp_path: Path) -> None:
    """Four photographs of a plane at a known depth, fitted with and without the points on it."""
    scene = open_scene(str(workspace(tmp_path / "plane", [1.0] * 10)), SceneOptions())
    scene = replace(scene, train=scene.train[:4])
    scale = float(scene.scale)

    def error(*changes: str) -> float:
        """Mean relative error of the depth that the plane's rays of a test view have."""
        fewer = ["batches.rays=512", "batches.samples=8192"]
        plan = build_plan(load_method("volumetric/hash", overrides=[*fewer, *changes]), scene, Budget(None, 120), 0, CPU)
        fit = Fit(plan)
        fit.run(lambda loss: False)
        camera = scene.test[0].camera
        depth = fit.model.render(camera, normals=False).depth.flatten() * scale
        rays = camera.rays()
        origins = rays.origins @ scene.world_from_local[:3, :3].T + scene.world_from_local[:3, 3]
        directions = rays.directions @ scene.world_from_local[:3, :3].T / scale
        true = -origins[:, 2] / directions[:, 2]
        on_plane = (origins + true[:, None] * directions)[:, :2].abs().amax(dim=1) < 0.7
        return float(((depth - true).abs() / true)[on_plane].clamp_max(1).mean())

    with_points, without = error(), error("training.sparse_depth.weight=0")
    assert with_points < 0.75 * without, (with_points, without)


def test_a_run_says_that_points_supervise_depth_and_how_not_to(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = str(workspace(tmp_path / "plane", [1.0] * 10))
    small = tuple(SMALL["volumetric/hash"])
    request = FitRequest(method="volumetric/hash", scene=scene, budget="2steps", out=str(tmp_path / "run"), overrides=small)
    folder = RunFolder(fit_run(request))
    said = capfd.readouterr().err
    assert "training photographs end at points of structure from motion, unless --set training.sparse_depth.weight=0" in said
    assert "end at points" in folder.read(Provenance).sparse_depth
    changes = (*small, "training.sparse_depth.weight=0")
    folder = RunFolder(fit_run(replace(request, overrides=changes, out=str(tmp_path / "without"))))
    assert "depth: " not in capfd.readouterr().err and folder.read(Provenance).sparse_depth == ""
