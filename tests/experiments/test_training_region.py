"""The box of a fit: made of the views that it sees, kept with the run, the data set's where poses are in doubt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import invgraphics as ig
from invgraphics.core import Bounds, Scene
from invgraphics.experiments.evaluate import evaluate_run
from invgraphics.experiments.fitted import load_fitted
from invgraphics.experiments.job import Job, make_training_scene
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.testing import toy_scene

SMALL = ig.load_method("volumetric/nerf", set={"field.layers": 2, "field.width": 8, "batches.rays": 32})


@pytest.fixture(scope="module")
def wide() -> Scene:
    corner, scene = torch.full((3,), 2.0), toy_scene(views=24, size=32)
    views = {split: tuple(replace(view, depth=None) for view in getattr(scene, split)) for split in ("train", "val", "test")}
    return replace(scene, bounds=Bounds(-corner, corner), **views)


def job(*overrides: str) -> Job:
    return Job.of(FitRequest(method="volumetric/nerf", scene="toy", overrides=overrides, budget="1steps", out="out"))


def edges(scene: Scene) -> list[float]:
    return [*scene.bounds.lo.tolist(), *scene.bounds.hi.tolist()]


def test_withheld_views_have_no_part_in_it(wide: Scene) -> None:
    """Fewer views leave a larger hull, which does not change with what the others show."""
    all_views, few = make_training_scene(job(), wide), make_training_scene(job("data.train_views=8"), wide)
    assert all_views.bounds.radius < few.bounds.radius < wide.bounds.radius
    kept = {view.name for view in few.train}
    other = tuple(
        view
        if view.name in kept
        else replace(view, alpha=torch.zeros(32, 32, dtype=torch.uint8), image=torch.zeros_like(view.image))
        for view in wide.train
    )
    assert edges(make_training_scene(job("data.train_views=8"), wide.with_views(train=other))) == edges(few)


@pytest.mark.parametrize("overrides", [["data.pose_noise=1"], ["training.poses.optimise=true"], ["data.box=scene"]])
def test_nothing_is_cut_off_where_poses_are_in_doubt_or_the_data_sets_box_is_asked_for(
    wide: Scene, overrides: list[str]
) -> None:
    assert edges(make_training_scene(job(*overrides), wide)) == edges(wide)


def test_a_run_opens_in_the_box_of_its_fit(wide: Scene, tmp_path: Path) -> None:
    fit = ig.fit(SMALL, wide, budget="2steps", data={"train_views": 8}, out=tmp_path / "run")
    provenance = RunFolder(tmp_path / "run").read(Provenance)
    model = load_fitted(RunFolder(tmp_path / "run"), wide).model
    expected = make_training_scene(job("data.train_views=8"), wide)
    assert provenance.region is not None and [*provenance.region[0], *provenance.region[1]] == edges(expected)
    assert torch.equal(model.bounds.lo, expected.bounds.lo) and torch.equal(model.bounds.hi, expected.bounds.hi)
    in_memory = ig.fit(SMALL, wide, budget="2steps", data={"train_views": 8})
    for opened in (fit, in_memory):
        assert torch.equal(opened.model.bounds.lo, expected.bounds.lo)
        assert torch.equal(opened.scene.bounds.hi, expected.bounds.hi)


def test_runs_from_before_have_the_data_sets_box(wide: Scene, tmp_path: Path) -> None:
    ig.fit(SMALL, wide, budget="2steps", out=tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    folder.write(replace(folder.read(Provenance), region=None))
    assert torch.equal(load_fitted(folder, wide).model.bounds.lo, wide.bounds.lo)


FINE = ("field.encoding.min_spacing=1", "field.encoding.finest=512", "field.encoding.log2_size=8", "batches.rays=64")


@pytest.mark.parametrize("changes", [{"size": 12}, {"train_views": 5}, {"pose_noise": 8.0}])
@pytest.mark.parametrize("method", ["volumetric/hash", "planes/mpi"])
def test_a_field_as_fine_as_its_training_pictures_is_loaded_as_it_was_fitted(
    method: str, changes: dict[str, float], tmp_path: Path
) -> None:
    """Its sizes are those of the pictures that the fit saw, not of the scene as loaded."""
    facing = ig.save_scene(toy_scene(views=10, size=24, facing="forward"), tmp_path / "facing.npz")
    overrides = FINE if method == "volumetric/hash" else ("field.count=4",)
    request = FitRequest(
        method=method,
        scene=str(facing),
        out=str(tmp_path / "run"),
        budget="20steps",
        overrides=(*overrides, *(f"data.{name}={value}" for name, value in changes.items())),
    )
    run = fit_run(request)
    scored = RunFolder(run).read_scores().quality["psnr"].per_view
    assert evaluate_run(run, protocol="float").quality["psnr"].per_view == pytest.approx(scored, abs=0.02)
