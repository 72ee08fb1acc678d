"""A study's file: what is refused, and what it expands to."""

import itertools
import tomllib
from pathlib import Path

import pytest

from invgraphics.errors import InputError
from invgraphics.experiments.request import AblateRequest
from invgraphics.recipes.recipe import load_method
from invgraphics.studies.cells import make_plan
from invgraphics.studies.reading import locate, name_of, read_study, with_request
from invgraphics.training.budget import Budget

HEAD = 'question = "Why?"\nscenes = ["a", "b"]\nmethods = ["volumetric/hash", "splatting/gaussians"]\nseeds = [0, 1]\n'
HASH = 'question = "Why?"\nscenes = ["a"]\nmethods = ["volumetric/hash"]\n'
TABLE, SAMPLES = "field.encoding.log2_size", "renderer.sampler.steps_per_diagonal"
TWO = f'[factors]\n"{TABLE}" = [10, 12, 14]\n{SAMPLES} = [64, 128]\n'


@pytest.fixture
def study(tmp_path: Path):
    def read(text: str):
        (tmp_path / "trial.toml").write_text(text)
        return read_study(tmp_path / "trial.toml")

    return read


def _levels(study) -> list[tuple]:
    return [tuple(point.values()) for point in study.points()]


def test_factorial_is_every_combination(study) -> None:
    """Quoted and nested keys are the same name."""
    found = study(HASH + TWO)
    assert list(found.factors) == [TABLE, SAMPLES]
    assert _levels(found) == list(itertools.product([10, 12, 14], [64, 128]))
    assert found.base == {TABLE: 10, SAMPLES: 64}


def test_one_at_a_time_varies_around_the_base(study) -> None:
    found = study(HASH + 'design = "one-at-a-time"\n' + TWO + f'[base]\n"{TABLE}" = 12\n')
    assert _levels(found) == [(12, 64), (10, 64), (14, 64), (12, 128)]


def test_a_list_is_taken_as_it_is(study) -> None:
    cells = f'[base]\nbudget = "9s"\n[[cells]]\n"{TABLE}" = 10\n[[cells]]\n"{TABLE}" = 14\nbudget = "1s"\n'
    found = study(HASH + 'design = "list"\n' + cells)
    assert found.factors == {TABLE: [10, 14], "budget": ["9s", "1s"]}
    assert _levels(found) == [(10, "9s"), (14, "1s")]


def test_no_factors_is_a_comparison(study) -> None:
    found = study(HEAD)
    assert found.points() == [{}]
    assert len(found.expand()) == 2 * 2 * 2


def test_a_scoped_factor_multiplies_its_own_methods_only(study) -> None:
    found = study(HEAD + f'[factors]\n"volumetric/*:{TABLE}" = [10, 12]\n"data.train_views" = [3, 6]\n')
    cells = found.expand()
    count = {method: sum(cell.method == method for cell in cells) for method in found.methods}
    assert count == {"volumetric/hash": 2 * 2 * 4, "splatting/gaussians": 2 * 2 * 2}
    assert {cell.levels[f"volumetric/*:{TABLE}"] for cell in cells if cell.method.startswith("splatting")} == {10}
    # Seed by seed, so that a study that is cut short has all its cells once before it has one of them twice.
    assert [cell.seed for cell in cells] == sorted(cell.seed for cell in cells)


def test_a_cell_becomes_a_request(study, tmp_path: Path) -> None:
    text = (
        f'budget = "7s"\nsize = [64, 48]\ntest_views = "all"\npreset = "paper"\n[factors]\n"volumetric/*:{TABLE}" = [10, 12]\n'
    )
    text += '"data.background" = ["random", "white"]\n[base]\n"splatting/*:field.sh_degree" = 1\n'
    found = study(HEAD + text)
    request = AblateRequest(study="trial", out=str(tmp_path / "o"))
    fits = [found.fit_request(cell, request) for cell in found.expand()]
    assert fits[0].overrides == (f"{TABLE}=10", 'data.background="random"')
    assert fits[1].method == "splatting/gaussians"
    assert fits[1].overrides == ('data.background="random"', "field.sh_degree=1")
    assert (fits[0].budget, fits[0].size, fits[0].test_views, fits[0].preset) == ("7s", (64, 48), None, "paper")
    assert fits[0].recipe_overrides == (f"{TABLE}=10",) and fits[0].data_overrides == ('data.background="random"',)
    varied = study(HASH + '[factors]\nbudget = ["1s", "2s"]\n')
    assert [varied.fit_request(cell, request).budget for cell in varied.expand()] == ["1s", "2s"]


def test_folders_are_named_by_what_defines_the_run(study, tmp_path: Path) -> None:
    request = AblateRequest(study="trial", out=str(tmp_path))
    plan = make_plan(study(HASH + TWO), request)
    ids = [planned.id for planned in plan]
    assert len(set(ids)) == 6
    assert ids[0].startswith("a-volumetric-hash-log2_size=10-steps_per_diagonal=64-seed=0-")
    # The order of factors and the rest of the study do not matter; what is run does.
    turned = HASH + f'[factors]\n{SAMPLES} = [128, 64]\n"{TABLE}" = [14, 12]\n'
    hashes = {planned.id[-10:] for planned in make_plan(study(turned), request)}
    assert hashes == {name[-10:] for name in ids[2:]}
    made = tmp_path / "runs" / ids[3]
    made.mkdir(parents=True)
    assert ids[3] in {planned.id for planned in make_plan(study(turned), request)}, "what is finished is found again"
    made.rmdir()
    noisy = make_plan(study(HASH + TWO + "[base]\ndata.photo_noise = 0.1\n"), request)
    longer = make_plan(study('budget = "61s"\n' + HASH + TWO), request)
    assert not {p.id[-10:] for p in (*noisy, *longer)} & {name[-10:] for name in ids}
    # An explicit default is the same run as none: the resolved recipe counts.
    laptop = load_method("volumetric/hash").table["batches"]["rays"]
    plain, said = (make_plan(study(HASH + more), request) for more in ("", f"[base]\nbatches.rays = {laptop}\n"))
    assert plain[0].fit.out == said[0].fit.out


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("question = ", "is not valid TOML"),
        (HEAD + "desing = 3\n", r"trial\.toml: Unknown key 'desing'"),
        (HEAD.replace('["a", "b"]', "[]"), "'scenes' has no entries"),
        (HEAD.replace('"b"', '"a"'), "'scenes' has 'a' twice"),
        (HEAD.replace('"b"', '"./a"'), "'scenes' has one data set twice, as 'a' and './a'"),
        (HEAD.replace("[0, 1]", "[1, 1]"), "'seeds' has 1 twice"),
        (HEAD.replace("[0, 1]", "[-1]"), "seeds must be 0 or more"),
        (HEAD + 'budget = "long"\n', "'long' is not a budget"),
        (HEAD + "test_views = 0\n", "'test_views' 1 or more"),
        (HEAD + '[factors]\n"batches.rays" = []\n', "factor 'batches.rays' has no entries"),
        (HEAD + '[factors]\n"batches.rays" = [8, 9, 8]\n', "has 8 twice"),
        (HEAD + '[factors]\n"batches.rays" = 8\n', "is not a list of levels"),
        (HEAD + '[factors]\n"batches.rays" = [{ a = 1 }]\n', "cannot be {'a': 1}"),
        (HEAD + '[factors]\n"batches.rays" = [inf]\n', "cannot be inf"),
        (HEAD + '[factors]\nbudget = ["5s", "5parsecs"]\n', "'5parsecs' is not a budget"),
        (HEAD + '[factors]\n"batches.rays" = [8, 9]\n[base]\n"batches.rays" = 7\n', "none of its levels"),
        (HEAD + '[factors]\n"hybrid/*:a" = [1, 2]\n', "belongs to none of the study's methods"),
        (HEAD + '[factors]\n"a" = [1, 2]\n"volumetric/*:a" = [3, 4]\n', "'a' is set by two entries for volumetric/hash"),
        (HEAD + 'each = "scene"\n', "the question names 'scene', which is no factor"),
        (HEAD + 'interactions = [["method", "method"]]\n', "cannot interact with itself"),
        (HEAD + "margins = { psnr = 0.0 }\n", "the margin of 'psnr' cannot be 0.0"),
        (
            HEAD + '[factors]\n"batches.rays" = [8, 9]\n[words]\n"batches.rays 7" = "few"\n',
            r"\[words\] names 'batches.rays 7', which is no level. Did you mean 'batches.rays [89]'",
        ),
        (HEAD + 'design = "list"\n', r"needs \[\[cells\]\]"),
        (HEAD + "[[cells]]\na = 1\n", r"needs \[\[cells\]\]"),
        (HEAD + 'design = "list"\n[[cells]]\na = 1\n[[cells]]\nb = 1\n', "cell 2 has no 'a'"),
    ],
)
def test_bad_studies_are_refused(study, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        study(text)


@pytest.mark.parametrize(
    ("text", "sentence", "remedy"),
    [
        (f"[factors]\n{TABLE} = [10, 12]\n", "Unknown key 'field.encoding'", '"METHOD:key"'),
        ('[factors]\n"data.viewz" = [1, 2]\n', "Unknown key 'data.viewz'", "train_views"),
        ('[factors]\n"batches.rays" = [1.5]\n', "'batches.rays' cannot be 1.5", "whole number"),
        ('protocol = "mine"\n', "no protocol 'mine'", "default"),
        ('preset = "huge"\n', "no preset 'huge'", "laptop"),
    ],
)
def test_levels_that_a_method_cannot_take_are_refused(study, tmp_path: Path, text: str, sentence: str, remedy: str) -> None:
    with pytest.raises(InputError) as error:
        make_plan(study(HEAD + text), AblateRequest(study="trial", out=str(tmp_path)))
    assert sentence in error.value.sentence and remedy in error.value.remedy
    assert len(str(error.value).splitlines()) <= 4


def test_the_command_line_overrides(study) -> None:
    found = study(HEAD)
    request = AblateRequest(study="trial", out="o", seeds=(5,), budget="3s", size=32, test_views="all")
    changed = with_request(found, request)
    assert (changed.seeds, changed.budget, changed.size, changed.test_views) == ((5,), "3s", 32, "all")
    assert with_request(found, AblateRequest(study="trial", out="o")) == found
    with pytest.raises(InputError, match="1 twice"):
        with_request(found, AblateRequest(study="trial", out="o", seeds=(1, 1)))
    with pytest.raises(InputError, match="--budget"):
        with_request(study(HEAD + '[factors]\nbudget = ["1s", "2s"]\n'), request)


def test_studies_are_found_by_name_file_and_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "study.toml").write_text(HEAD)
    (tmp_path / "other.toml").write_text(HEAD)
    for text, name in (("families", "families"), (str(tmp_path / "mine"), "mine"), (str(tmp_path / "other.toml"), "other")):
        assert name_of(locate(text)) == name
    with pytest.raises(InputError, match="no study 'nowhere'"):
        locate("nowhere")


@pytest.mark.parametrize("path", sorted(Path(locate("families")).parents[1].glob("*/study.toml")), ids=lambda p: p.parent.name)
def test_the_studies_that_come_along_are_whole_and_short(path: Path, tmp_path: Path) -> None:
    """Every level fits its methods; an hour on two cores, with a third of the fit's time for start and evaluation.

    Twenty steps are taken for a second. Some take hours: the gauntlet, whose own test says what it covers, integral-or-splat,
    whose question is about up to 100,000 Gaussians, its replication at a 160th, whose steps are short, families, with seven
    methods on seven scenes, lattices, as many on six for a minute, gaussian-ablation and samples-x-table, whose steps are
    short, and published and published-cones, whose fits take an hour each.
    """
    hours = {"gauntlet": 10, "integral-or-splat": 15, "integral-or-splat-64px": 3, "published": 5, "published-cones": 5}
    hours |= dict.fromkeys(("families", "lattices", "gaussian-ablation", "samples-x-table"), 2)
    study = read_study(path)
    plan = make_plan(study, AblateRequest(study=str(path), out=str(tmp_path)))
    assert len({planned.fit.out for planned in plan}) == len(plan)
    budgets = [Budget.parse(planned.fit.budget) for planned in plan]
    seconds = sum(budget.seconds or (budget.steps or 0) / 20 for budget in budgets)
    assert 0 < seconds * 4 / 3 < 3600 * hours.get(path.parent.name, 1)
    assert tomllib.loads(path.read_text())["question"].endswith("?")
