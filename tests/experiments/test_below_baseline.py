"""The sentence about methods that lose to the mean training image, on pictures made by hand."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_fixtures import SMALL

import invgraphics as ig
from invgraphics.core import Bounds, Camera, Points, Rendering, Scene, View
from invgraphics.experiments import evaluate
from invgraphics.experiments.below_baseline import below_baseline, coverage_and_depth
from invgraphics.experiments.evaluate import evaluate_run
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.metrics.baselines import baseline_scores
from invgraphics.metrics.protocols import protocol_named, score, summarise
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.scores import Score
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.scenes.open import SceneOptions, open_scene


def scene() -> Scene:
    """Training views that are black and white: their mean is grey. The test view is light grey."""
    pose = torch.eye(4)
    pose[2, 3] = -2.0
    camera = Camera(pose, torch.tensor([20.0, 20.0]), torch.tensor([8.0, 8.0]), 16, 16)
    views = [View(camera, torch.full((16, 16, 3), value), str(value)) for value in (0.0, 1.0, 0.6)]
    bounds = Bounds(-torch.ones(3), torch.ones(3), "contracted")
    return Scene("grey", tuple(views[:2]), (views[2],), torch.zeros(3), bounds)


def picture(colour: float, alpha: float, depth: float) -> Rendering:
    full = torch.full((16, 16), 1.0)
    return Rendering(torch.full((16, 16, 3), colour), alpha * full, depth * full)


@pytest.mark.parametrize(
    ("method", "colour", "alpha", "depth", "words"),
    [
        ("volumetric/hash", 0.2, 0.9, 0.4, "fog hangs in front of the cameras (median depth 20% of the way"),
        ("volumetric/hash-proposal", 0.2, 0.9, 0.4, "fog hangs in front of the cameras"),
        ("volumetric/nerf", 0.2, 0.4, 9.0, "mostly empty (mean alpha 0.40)"),
        ("volumetric/nerf", 0.2, 1.0, 2.0, "budget ended"),
        ("splatting/gaussians", 0.2, 0.4, 9.0, "Gaussians do not cover"),
        ("volumetric/hash", 0.55, 0.9, 0.4, ""),
    ],
)
def test_says_why_and_what_to_try(method: str, colour: float, alpha: float, depth: float, words: str) -> None:
    shown, rules = scene(), protocol_named("default")
    prediction, view = picture(colour, alpha, depth), scene().test[0]
    quality, _ = summarise([score(prediction, view, shown, rules, only=("psnr",))], rules)
    seen, splats = [coverage_and_depth(prediction, view.camera, shown)], method.startswith("splatting/")
    found = below_baseline(method, quality, seen, shown, rules, gaussians=splats)
    if words:
        assert words in found
        assert found.startswith(f"{method} reaches 8.0 dB, below the mean training image (20.2 dB): ")
        assert " Try a longer --budget" in found
        assert "splatting" not in found.removeprefix(method) or method.startswith("volumetric")
        # Opaque photographs of a space without end.
        remedies = {
            "volumetric/hash": "volumetric/hash-proposal, for open",
            "volumetric/nerf": "volumetric/hash-proposal, for open",
            "volumetric/hash-proposal": "--optimise exposure",
        }
        assert remedies.get(method, "") in found
        points = replace(shown, points=Points(torch.zeros(2, 3), torch.zeros(2, 3)))
        known = below_baseline(method, quality, seen, points, rules, gaussians=splats)
        assert [("starts from known points" in text) for text in (found, known)] == [False, not splats]
    else:
        assert found == ""


def test_says_when_a_small_object_has_vanished() -> None:
    alpha = torch.zeros(16, 16)
    alpha[4:8, 4:8] = 1
    opaque, rules = scene(), protocol_named("default")
    shown = replace(opaque, train=tuple(replace(view, alpha=alpha) for view in opaque.train))
    for left, words in ((0.001, "its pictures are empty (mean alpha 0.001 instead of 0.062)"), (0.05, "budget ended")):
        prediction, view = picture(0.0, left, 2.0), shown.test[0]
        quality = {"psnr": Score(mean=1.0, unit="dB", higher_is_better=True, per_view=(1.0,))}
        found = below_baseline("hybrid/neus", quality, [coverage_and_depth(prediction, view.camera, shown)], shown, rules)
        assert words in found
        assert ("Try --set batches.foreground=0.5" in found) == (left == 0.001)


def test_the_mean_is_over_the_photographs_that_the_method_saw(toy_folder: Path, tmp_path: Path) -> None:
    """As the table's baseline is, also when a run is scored again."""
    settings = (*SMALL["splatting/gaussians"], "field.opacity=0.9")
    overrides = (*settings, "data.train_views=1", "data.init=random")
    scene, out = str(toy_folder), str(tmp_path / "run")
    fit_run(FitRequest(method="splatting/gaussians", scene=scene, out=out, budget="1steps", overrides=overrides))
    full = open_scene(str(toy_folder), SceneOptions())
    seen, rules = degrade(full, TrainingData(train_views=1), 0), protocol_named("default")
    assert torch.equal(evaluate.scene_as_trained(full, {"background": "black"}, 0).background, full.background)
    own, other = (baseline_scores(one, rules)["mean image"]["psnr"].mean for one in (seen, full))
    assert f"{own:.1f}" != f"{other:.1f}"
    first = RunFolder(tmp_path / "run").read_scores()
    run, faint = ig.load_run(out), {key: json.loads(value) for key, _, value in (item.partition("=") for item in settings)}
    in_memory = ig.fit(
        ig.load_method("splatting/gaussians", set=faint), full, "1steps", data={"train_views": 1, "init": "random"}
    )
    again = [ig.evaluate(fit, full) for fit in (run, in_memory)]
    again += [run.evaluate(), in_memory.scores]
    assert "Gaussians do not cover" in ig.evaluate(in_memory.model, full).record.below_baseline, "whatever it is called"
    (said,) = {first.below_baseline, evaluate_run(Path(out)).below_baseline}
    assert f"below the mean training image ({own:.1f} dB)" in said
    assert [f"({own:.1f} dB)" in scores.record.below_baseline for scores in again] == [True] * 4


def test_says_nothing_where_there_is_nothing_to_compare_with() -> None:
    shown = scene()
    assert below_baseline("volumetric/hash", {}, [], shown, protocol_named("default")) == ""
    alone = shown.with_views(train=())
    assert (
        below_baseline(
            "volumetric/hash", {"psnr": Score(mean=1.0, higher_is_better=True)}, [], alone, protocol_named("default")
        )
        == ""
    )
