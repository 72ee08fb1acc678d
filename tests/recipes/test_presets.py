"""The preset that a budget chooses, what is said about it, and where that ends up."""

import json
import math
from pathlib import Path

import pytest
from made_up_runs import provenance_table

from invgraphics.errors import InputError
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import AblateRequest, FitRequest
from invgraphics.recipes.presets import announcements, preset_for
from invgraphics.recipes.recipe import load_method
from invgraphics.report.pages.facts import preset_facts
from invgraphics.runs.run import read_run
from invgraphics.studies.ablate import _cost_key
from invgraphics.studies.cells import make_plan
from invgraphics.studies.reading import read_study
from invgraphics.training.budget import Budget

ALL = ("hour", "laptop", "long", "paper")

RECIPE = """
summary = "a recipe with three presets"
paper = "none"
[field]
type = "neural"
width = 8
[renderer]
type = "volumetric"
[[losses]]
type = "photometric"
[optimiser.groups.all]
match = "field"
lr = 1e-3
[presets.laptop]
field = { width = 16 }
[presets.long]
field = { width = 32 }
chosen_on = ["bricks", "fence"]
"""


@pytest.fixture
def recipe(tmp_path: Path) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(RECIPE)
    return str(path)


@pytest.mark.parametrize(
    ("budget", "known", "expected"),
    [
        ("60s", ALL, "laptop"),
        ("119.9s", ALL, "laptop"),
        ("2m", ALL, "long"),
        ("30m", ALL, "long"),
        ("1801s", ALL, "hour"),
        ("1h", ("laptop", "long", "paper"), "long"),
        ("1h", ("laptop", "hour"), "hour"),
        ("10m", ("laptop", "hour"), "laptop"),  # the nearest smaller one, never a larger one
        ("10m", ("hour", "paper"), ""),
        ("500000steps", ALL, "laptop"),
        ("1h", ("paper",), ""),
    ],
)
def test_the_budget_chooses(budget: str, known: tuple[str, ...], expected: str) -> None:
    assert preset_for(Budget.parse(budget), known) == expected


def test_no_budget_is_a_short_one() -> None:
    assert preset_for(None, ALL) == "laptop"


def test_a_chosen_preset_is_laid_over_the_recipe_and_says_so(recipe: str) -> None:
    method = load_method(recipe, None, (), Budget.parse("5m"))
    assert (method.preset, method.recipe.field.width) == ("long", 32)
    assert method.chosen_on == ("bricks", "fence")
    assert announcements([method.choice]) == [f"{recipe}: preset long, chosen from the budget of 5 min; --preset overrides."]
    assert "chosen_on" not in json.dumps(method.table)
    forced = load_method(recipe, "laptop", (), Budget.parse("5m"))
    assert (forced.preset, forced.recipe.field.width, forced.chosen_on) == ("laptop", 16, ())
    assert announcements([forced.choice]) == []
    assert load_method(recipe, "", (), Budget.parse("5m")).recipe.field.width == 8


def test_the_scenes_a_preset_was_chosen_on_do_not_change_the_run(recipe: str) -> None:
    before = load_method(recipe, "long").digest
    Path(recipe).write_text(RECIPE.replace('chosen_on = ["bricks", "fence"]\n', ""))
    assert load_method(recipe, "long").digest == before
    Path(recipe).write_text(RECIPE.replace('["bricks", "fence"]', '"bricks"'))
    with pytest.raises(InputError, match=r"'presets\.long\.chosen_on' of .* cannot be 'bricks'"):
        load_method(recipe, "long")


def test_steps_are_told_apart_from_seconds(recipe: str) -> None:
    steps = load_method(recipe, None, (), Budget.parse("90000steps"))
    assert announcements([steps.choice]) == [f"{recipe}: preset laptop, as for every budget in steps; --preset overrides."]


def test_lengths_of_budgets_are_exact() -> None:
    said = {
        text: load_method("volumetric/hash", None, (), Budget.parse(text)).preset_choice for text in ("100s", "150s", "90m")
    }
    assert [choice.removeprefix("chosen from the budget of ") for choice in said.values()] == ["100 s", "2.5 min", "1.5 h"]


def test_methods_with_one_choice_share_a_sentence() -> None:
    choices = [("a/b", "long", "chosen"), ("c/d", "long", "chosen"), ("a/b", "long", "chosen"), ("e/f", "laptop", "chosen")]
    assert announcements(choices) == [
        "a/b, c/d: preset long, chosen; --preset overrides.",
        "e/f: preset laptop, chosen; --preset overrides.",
    ]


def test_the_budget_of_each_cell_chooses(recipe: str, tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text(
        f'question = "q"\nscenes = ["bricks"]\nmethods = ["{recipe}"]\n[factors]\nbudget = ["60s", "5m", "100steps"]\n'
    )
    plan = make_plan(read_study(study), AblateRequest(study=str(study), out=str(tmp_path)))
    assert [planned.method.preset for planned in plan] == ["laptop", "long", "laptop"]
    assert [planned.method.recipe.field.width for planned in plan] == [16, 32, 16]
    assert len({_cost_key(planned) for planned in plan}) == 2  # two forecasts
    for planned in plan:  # the process that fits comes to the same preset
        assert Job.of(planned.fit).method.digest == planned.method.digest


def test_a_request_names_its_method(recipe: str) -> None:
    request = FitRequest(method=recipe, scene="bricks", out="x", budget="45m", overrides=("field.width=5", "data.size=9"))
    method = Job.of(request).method
    assert (method.preset, method.recipe.field.width) == ("long", 5)


def _run(folder: Path, method: str, preset: str, **provenance: object):
    folder.mkdir()
    scores = {"method": method, "seed": 0, "preset": preset, "views": [], "quality": {}, "cost": {"fit_seconds": math.pi}}
    (folder / "scores.json").write_text(json.dumps(scores))
    (folder / "provenance.json").write_text(json.dumps(provenance_table(**provenance)))
    (folder / "environment.json").write_text("{}")
    (folder / "history.jsonl").write_text("")
    return read_run(folder)


def test_the_page_says_what_chose_the_preset(tmp_path: Path) -> None:
    chosen = {"preset_choice": "chosen from the budget of 5 min"}
    hash_ = _run(tmp_path / "a", "volumetric/hash", "long", preset_chosen_on=["bricks", "fence"], **chosen)
    same = _run(tmp_path / "b", "splatting/gaussians", "long", preset_chosen_on=["bricks", "fence"], **chosen)
    other = _run(tmp_path / "c", "volumetric/nerf", "laptop", **chosen)
    old = _run(tmp_path / "d", "volumetric/nerf", "laptop")
    assert preset_facts([hash_, same]) == {
        "preset": "long, chosen from the budget of 5 min",
        "preset chosen on": "bricks, fence",
    }
    assert preset_facts([hash_, other]) == {
        "preset": "long (volumetric/hash); laptop (volumetric/nerf), chosen from the budget of 5 min",
        "preset chosen on": "bricks, fence (volumetric/hash); not stated (volumetric/nerf)",
    }
    assert preset_facts([old]) == {"preset": "laptop"}
    assert preset_facts([], "paper") == {"preset": "paper"}
