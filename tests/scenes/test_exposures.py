"""Exposures of photographs by the points they share: known factors, highlights, too little in common, COLMAP's tracks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tracked_plane import SIZE, photographs, workspace

from invgraphics.core import Scene
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
