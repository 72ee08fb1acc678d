"""A request is read once: what it says is resolved at the door, and refused there."""

from pathlib import Path

import pytest
import torch
from training_fixtures import SMALL

from invgraphics.errors import InputError
from invgraphics.experiments.compare import compare
from invgraphics.experiments.identity import cell_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import CompareRequest, FitRequest
from invgraphics.recipes import recipe
from invgraphics.scenes.degrade import TrainingData
from invgraphics.scenes.open import SceneOptions
from invgraphics.training.budget import Budget, Cadence

METHOD = "splatting/gaussians"


def _request(**more) -> FitRequest:
    return FitRequest(**{"method": METHOD, "scene": "bricks", "out": "runs/a"} | more)


def test_text_becomes_values() -> None:
    job = Job.of(
        _request(
            budget="2m",
            checkpoint_every="7steps",
            overrides=("data.train_views=5", "field.sh_degree=1"),
            size=64,
            spp=4,
            protocol="float",
            render_with=("gaussian-volume/exact:steps=8",),
        )
    )
    assert (job.budget, job.cadence) == (Budget(seconds=120.0), Cadence(steps=7))
    assert job.data == TrainingData(train_views=5)
    assert (job.method.preset, job.method.recipe.field.sh_degree) == ("long", 1)
    assert job.options == SceneOptions(size=64, test_views=16, spp=4)
    assert job.device == torch.device("cpu")
    assert job.protocols == ("float", "default")
    assert [variant.table["steps"] for variant in job.variants] == [8]
    assert job.folder.root == Path("runs/a")


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"budget": "long"}, "'long' is not a budget"),
        ({"checkpoint_every": "never"}, "'never' is no interval"),
        ({"checkpoint_every": "0s"}, "'0s' is no interval"),
        ({"checkpoint_every": "1.5steps"}, "'1.5steps' is no interval"),
        ({"overrides": ("data.siez=9",)}, "Unknown key 'data.siez'"),
        ({"device": "tpu"}, "The device cannot be 'tpu'"),
        ({"protocol": "flaot"}, "There is no protocol 'flaot'"),
        ({"render_with": ("gaussian-volume/exatc",)}, "There is no method 'gaussian-volume/exatc'"),
        ({"size": 0}, "size 0 is not positive"),
    ],
)
def test_what_cannot_be_read_is_refused(wrong: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Job.of(_request(**wrong))


@pytest.mark.parametrize(("text", "seconds"), [("30s", 30.0), ("5min", 300.0), ("1.5m", 90.0), ("1h", 3600.0)])
def test_checkpoints_come_at_any_unit_of_a_budget(text: str, seconds: float) -> None:
    assert Job.of(_request(checkpoint_every=text)).cadence == Cadence(seconds=seconds)


def test_a_budget_counts_and_not_its_spelling() -> None:
    assert cell_digest(Job.of(_request(budget="120s"))) == cell_digest(Job.of(_request(budget="2m")))
    assert cell_digest(Job.of(_request(budget="120s"))) != cell_digest(Job.of(_request(budget="121s")))


def test_a_comparison_reads_each_recipe_once(toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, plain = [], recipe.source
    monkeypatch.setattr(recipe, "source", lambda name: (read.append(name), plain(name))[1])
    monkeypatch.setattr("invgraphics.experiments.compare.LocalExecutor.run", lambda *_: (outcome for outcome in ()))
    methods = ("volumetric/hash", METHOD)
    overrides = tuple(item for item in SMALL[METHOD] if item in SMALL["volumetric/hash"])
    compare(CompareRequest(scene=str(toy_folder), out=str(tmp_path), methods=methods, seeds=(0, 1, 2), overrides=overrides))
    assert read == list(methods)


def test_methods_whose_runs_would_share_a_folder_are_refused(tmp_path: Path) -> None:
    """A recipe in one's own folder of the name of a built-in one, say."""
    request = CompareRequest(scene="bricks", out=str(tmp_path), methods=(METHOD, f"{METHOD}.toml"))
    with pytest.raises(InputError, match="would share the folder"):
        compare(request)
