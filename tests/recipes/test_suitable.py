"""Methods that a scene chooses: by a comparison that names none, and as a suggestion to a fit."""

from dataclasses import replace
from pathlib import Path

import pytest
from training_fixtures import SMALL, InProcess

from invgraphics.experiments import compare as comparing
from invgraphics.experiments.request import CompareRequest
from invgraphics.recipes import suitable
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.recipes.suitable import CLOSED, OPEN, default_methods, suggestion
from invgraphics.report.data.comparison import read_comparison
from invgraphics.report.pages.facts import protocol_facts
from invgraphics.runs.comparison import ComparisonRecord
from invgraphics.testing import toy_scene


def test_photographs_of_a_place_get_the_methods_for_open_spaces() -> None:
    scene = toy_scene(views=2, size=8, space="contracted")
    opaque = replace(scene, train=tuple(replace(view, alpha=None) for view in scene.train))
    assert default_methods(opaque)[0] == OPEN
    assert default_methods(scene)[0] == CLOSED  # cut out: its surroundings are empty
    boxed = replace(opaque, bounds=toy_scene(views=2, size=8).bounds)
    assert default_methods(boxed)[0] == CLOSED
    assert {*OPEN, *CLOSED} <= set(methods())
    for name in ("volumetric/hash", OPEN[0], "volumetric/nerf"):
        assert suggestion(load_method(name), opaque).startswith("--set data.init=sfm")
        moved = tuple(replace(view, ground_truth_pose=view.camera.cam_to_world) for view in opaque.train)
        assert "data.init" not in suggestion(load_method(name), replace(opaque, train=moved))  # nothing is triangulated there
    assert scene.points is not None
    landmarks = scene.points.position[:3]
    opaque = replace(opaque, train=tuple(replace(view, landmarks=landmarks) for view in opaque.train))
    for name in ("volumetric/hash", OPEN[0]):  # two photographs are few, but for scenes whose points are not known
        assert suggestion(load_method(name), opaque).startswith("splatting/gaussians, which starts from the 400 known points")
    assert suggestion(load_method(OPEN[1]), opaque) == ""
    opaque = replace(opaque, points=None)
    for name, suited in (("volumetric/hash", False), ("volumetric/nerf", False), (OPEN[0], True), (OPEN[1], True)):
        assert (suggestion(load_method(name), opaque) == "") is suited
        assert suggestion(load_method(name), boxed) == ""


def test_a_comparison_without_methods_says_what_it_chose_and_why(
    toy_folder: Path, tmp_path: Path, in_process: type[InProcess], monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(suitable, "CLOSED", ("splatting/gaussians",))
    request = CompareRequest(
        scene=str(toy_folder), methods=(), budget="2steps", out=str(tmp_path), overrides=tuple(SMALL["splatting/gaussians"])
    )
    folder, failures = comparing.compare(request)
    assert failures == 0
    sentence = "chosen for an object that is cut out: one method of each large family"
    assert f"Methods: splatting/gaussians, {sentence}; --methods overrides." in capsys.readouterr().err
    record = ComparisonRecord.read(folder / ComparisonRecord.FILE)
    assert (record.methods, record.method_choice) == (("splatting/gaussians",), sentence)
    assert "--methods splatting/gaussians" in record.command
    assert ("methods", sentence) in protocol_facts(read_comparison(folder))
