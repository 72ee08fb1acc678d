"""Exposures of photographs by the points they share: known factors, highlights, too little in common, COLMAP's tracks."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dots import save
from scipy.spatial.transform import Rotation

from invgraphics.core import Camera, Scene, View
from invgraphics.core.transforms import look_at, opencv_to_colmap
from invgraphics.experiments.build import build_plan
from invgraphics.experiments.posed import exposure_note
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.recipes.recipe import load_method
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.scenes.photos.exposures import exposure_spread
from invgraphics.training.budget import Budget

SIZE = 64


def photographs(factors: list[float], shiny: float = 0.0, seed: int = 0) -> tuple[list[View], torch.Tensor, list[torch.Tensor]]:
    """Photographs of a patterned plane z = 0 under known exposures, its points, and the rows of those that each shows."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.cat([torch.rand(400, 2, generator=generator) * 1.6 - 0.8, torch.zeros(400, 1)], dim=1)
    views, observed = [], []
    for index, factor in enumerate(factors):
        angle = 2 * math.pi * index / len(factors)
        pose = look_at(torch.tensor([math.cos(angle), math.sin(angle), 3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        camera = Camera(pose, torch.tensor([80.0, 80.0]), torch.tensor([32.0, 32.0]), SIZE, SIZE)
        rays = camera.rays()
        place = rays.origins + rays.directions * (-rays.origins[:, 2] / rays.directions[:, 2])[:, None]
        pattern = 0.3 + 0.15 * torch.sin(5 * place[:, :1]) * torch.cos(4 * place[:, 1:2])
        colour = (pattern * torch.tensor([1.0, 0.8, 0.6]) * factor).expand(-1, 3).clone()
        lit = torch.rand(len(colour), generator=generator) < shiny
        colour[lit] = 0.9
        views.append(View(camera, colour.reshape(SIZE, SIZE, 3), f"{index}"))
        kept = torch.rand(len(points), generator=generator) < 0.6
        observed.append(kept.nonzero().flatten())
    return views, points, observed


@pytest.mark.parametrize("shiny", [0.0, 0.1])
def test_the_spread_is_that_of_the_factors_whatever_shines(shiny: float) -> None:
    factors = [0.7, 0.8, 0.9, 1.0, 1.0, 1.2, 1.4, 1.6]
    found = exposure_spread(*photographs(factors, shiny))
    assert found == pytest.approx(float(np.log(factors).std()), rel=0.05)


def test_photographs_under_one_exposure_have_no_spread() -> None:
    assert exposure_spread(*photographs([1.0] * 8)) == pytest.approx(0, abs=0.01)


def test_factors_are_told_from_other_parts_of_the_scene() -> None:
    """Bright photographs show the bright half of the plane: their mean would say twice the spread."""
    factors = [0.8, 1.25] * 4
    views, points, observed = photographs(factors)
    bright = torch.sin(5 * points[:, 0]) * torch.cos(4 * points[:, 1]) > 0
    sides = [rows[bright[rows] == bool(index % 2)] for index, rows in enumerate(observed)]
    shared = [torch.cat([side, rows[::4]]).unique() for side, rows in zip(sides, observed, strict=True)]
    assert exposure_spread(views, points, shared) == pytest.approx(float(np.log(factors).std()), rel=0.05)


def test_what_is_masked_or_transparent_does_not_count() -> None:
    factors = [0.7, 0.8, 0.9, 1.0, 1.0, 1.2, 1.4, 1.6]
    views, points, observed = photographs(factors)
    left = torch.arange(SIZE)[None, :].expand(SIZE, -1) < SIZE // 2
    spoilt = [replace(view, image=torch.where(left[..., None], torch.full_like(view.image, 0.5), view.image)) for view in views]
    known = pytest.approx(float(np.log(factors).std()), rel=0.05)
    assert exposure_spread(spoilt, points, observed) != known
    assert exposure_spread([replace(view, mask=~left) for view in spoilt], points, observed) == known
    assert exposure_spread([replace(view, alpha=(~left).float()) for view in spoilt], points, observed) == known


def test_a_photograph_without_points_has_no_say() -> None:
    factors = [0.7, 0.8, 0.9, 1.0, 1.2, 1.4]
    views, points, observed = photographs(factors)
    observed[-1] = observed[-1][:0]
    assert exposure_spread(views, points, observed) == pytest.approx(float(np.log(factors[:-1]).std()), rel=0.05)


def test_nothing_is_estimated_from_two_photographs_or_points_seen_once() -> None:
    views, points, observed = photographs([0.8, 1.2])
    assert exposure_spread(views, points, observed) is None
    views, points, _ = photographs([0.8, 1.0, 1.2, 1.4])
    apart = [torch.arange(index * 100, index * 100 + 100) for index in range(4)]
    assert exposure_spread(views, points, apart) is None
    assert exposure_spread(views, points, [torch.zeros(0, dtype=torch.int64)] * 4) is None


def workspace(path: Path, factors: list[float]) -> Path:
    """The photographs as a COLMAP workspace, tracks included."""
    views, points, observed = photographs(factors)
    (path / "sparse/0").mkdir(parents=True)
    images = []
    for number, (view, rows) in enumerate(zip(views, observed, strict=True), 1):
        save((view.image * 255).round().byte().numpy(), path / "images" / f"{number}.png")
        world_to_cam = opencv_to_colmap(view.camera.cam_to_world.double()).numpy()
        x, y, z, w = Rotation.from_matrix(world_to_cam[:3, :3]).as_quat()
        tracks = " ".join(f"0 0 {3 * row + 7}" for row in rows.tolist())
        images.append(f"{number} {w} {x} {y} {z} {' '.join(map(str, world_to_cam[:3, 3]))} 1 {number}.png\n{tracks}")
    (path / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} 80 80 32 32\n")
    (path / "sparse/0/images.txt").write_text("\n".join(images) + "\n")
    lines = [f"{3 * row + 7} {' '.join(map(str, point))} 90 90 90 0.1" for row, point in enumerate(points.tolist())]
    (path / "sparse/0/points3D.txt").write_text("\n".join(reversed(lines)) + "\n")
    return path


def test_exposures_are_fitted_where_tracks_show_that_photographs_differ(tmp_path: Path) -> None:
    factors = [0.7, 0.8, 0.9, 1.0, 1.0, 1.2, 1.4, 1.6, 1.1, 0.8]
    scene = open_scene(str(workspace(tmp_path / "differ", factors)), SceneOptions())
    trained = [factors[int(view.name.removesuffix(".png")) - 1] for view in scene.train]
    assert scene.exposure_spread == pytest.approx(float(np.log(trained).std()), rel=0.1)
    assert "differ by" in scene.notes["exposures"]
    same = open_scene(str(workspace(tmp_path / "same", [1.0] * 10)), SceneOptions())
    assert same.exposure_spread == pytest.approx(0, abs=0.02)

    def fitted(changes: list[str], scene: Scene) -> tuple[bool, bool]:
        method = load_method("splatting/gaussians", overrides=changes)
        plan = build_plan(method, scene, Budget(seconds=None, steps=1), 0, torch.device("cpu"))
        return plan.exposures is not None, bool(exposure_note(method, scene))

    off, on = (f"training.exposure.optimise={value}" for value in ("false", "true"))
    assert [fitted(changes, scene) for changes in ([], [on], [off])] == [(True, True), (True, True), (False, False)]
    assert [fitted(changes, same) for changes in ([], [on], [off])] == [(False, False), (True, True), (False, False)]


@pytest.mark.parametrize("changes", [{"train_views": 4}, {"size": 32}, {"photo_noise": 0.1}, {"exposure": 0.5}])
def test_changed_photographs_do_not_keep_the_spread_of_the_others(tmp_path: Path, changes: dict[str, Any]) -> None:
    scene = open_scene(str(workspace(tmp_path / "differ", [0.7, 0.8, 0.9, 1.0, 1.0, 1.2, 1.4, 1.6, 1.1, 0.8])), SceneOptions())
    found = degrade(scene, TrainingData(init="random", **changes), 0)
    assert found.exposure_spread is None and "exposures" not in found.notes
    kept = degrade(scene, TrainingData(init="random"), 0)
    assert kept.exposure_spread == scene.exposure_spread and "exposures" in kept.notes


def test_a_run_says_that_it_fits_exposures_and_how_not_to(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = str(workspace(tmp_path / "differ", [0.7, 0.8, 0.9, 1.0, 1.0, 1.2, 1.4, 1.6, 1.1, 0.8]))
    request = FitRequest(method="splatting/gaussians", scene=scene, budget="2steps", out=str(tmp_path / "run"))
    folder = RunFolder(fit_run(request))
    said = capfd.readouterr().err
    assert "exposures: of the training photographs differ by" in said and "--set training.exposure.optimise=false" in said
    assert folder.read(Provenance).test_exposure == folder.read_scores().test_exposure != ""
    changes = ("training.exposure.optimise=false",)
    folder = RunFolder(fit_run(replace(request, overrides=changes, out=str(tmp_path / "without"))))
    assert "exposures:" not in capfd.readouterr().err
    assert folder.read(Provenance).test_exposure == folder.read_scores().test_exposure == ""
