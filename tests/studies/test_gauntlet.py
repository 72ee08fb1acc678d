"""A gauntlet in small, from its file to its page: cheap cells first, resumed, kept, skipped with a reason, and judged."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
from training_fixtures import SMALL

from invgraphics.errors import InputError
from invgraphics.experiments.request import AblateRequest
from invgraphics.report.study import build_study_report
from invgraphics.studies.ablate import ablate
from invgraphics.studies.cells import make_plan, select
from invgraphics.studies.forecast import Forecast
from invgraphics.studies.reading import locate, read_study, with_request
from invgraphics.training.budget import Budget

pytestmark = pytest.mark.usefixtures("unpainted")

METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")
LIST = 'question = "Does it hold?"\ndesign = "list"\nreport = "verdicts"\nscenes = ["a", "b"]\nseeds = [0, 1]\nsize = 64\n'
LIST += f"methods = {json.dumps(METHODS[1:])}\n"


@pytest.fixture
def gauntlet(toy_folder: Path, tmp_path: Path, monkeypatch) -> AblateRequest:
    """Three methods; two budgets of each, two sizes of one, and data that is not here."""
    monkeypatch.setenv("TOY_DATA", str(toy_folder.parent))
    scene = f"$TOY_DATA/{toy_folder.name}"
    head = f'question = "Does it hold?"\ndesign = "list"\nreport = "verdicts"\nscenes = ["{scene}", "$TOY_DATA/gone"]\n'
    head += f"methods = {json.dumps(METHODS)}\ntest_views = 2\n"
    keys = [(method, *item.split("=")) for method in METHODS for item in SMALL[method]]
    base = "[base]\n" + "".join(f'"{method}:{key}" = {value}\n' for method, key, value in keys)
    cells = f'[[cells]]\nscenes = ["{scene}"]\nsize = 24\nbudget = "4steps"\n'
    cells += '[[cells]]\nscenes = ["$TOY_DATA/gone"]\nmethods = ["volumetric/hash"]\nsize = 24\nbudget = "2steps"\n'
    cells += f'[[cells]]\nscenes = ["{scene}"]\nmethods = ["splatting/gaussians"]\nsize = 16\nbudget = "2steps"\n'
    cells += f'[[cells]]\nscenes = ["{scene}"]\nsize = 24\nbudget = "2steps"\n'
    (tmp_path / "small.toml").write_text(head + base + cells)
    return AblateRequest(study=str(tmp_path / "small.toml"), out=str(tmp_path / "out"))


def _yes(forecast: Forecast) -> None:
    assert forecast.hours < 1


def _cells(request: AblateRequest) -> dict[str, dict]:
    return {cell["label"]: cell for cell in json.loads((Path(request.out) / "study.json").read_text())["cells"]}


def _verdicts(folder: Path) -> dict[tuple[str, str], dict[str, str]]:
    with (folder / "verdicts.csv").open() as file:
        return {(row["cell"], row["rule"]): row for row in csv.DictReader(file)}


def test_a_small_gauntlet_from_its_file_to_its_verdicts(in_process, gauntlet, toy_folder: Path, capsys) -> None:
    in_process.fails = staticmethod(lambda fit: "Step 3: not finite." if fit.size == 16 else "")
    folder, failed = ablate(gauntlet, _yes)
    assert capsys.readouterr().err.count("Left out: gone is not in $TOY_DATA.\n") == 1
    name = toy_folder.name
    assert [cell.label for cell in failed] == [f"splatting/gaussians {name}@16 2steps seed=0"]
    cells = _cells(gauntlet)
    gone = cells["volumetric/hash gone@24 2steps seed=0"]
    assert (gone["status"], gone["error"]) == ("skipped", "gone is not in $TOY_DATA")
    for method in METHODS:
        provenance = json.loads((folder / cells[f"{method} {name}@24 4steps seed=0"]["run"] / "provenance.json").read_text())
        assert provenance["scene"] == f"$TOY_DATA/{name}" and provenance["options"] == {"size": 24, "test_views": 2}
        assert provenance["memory_forecast_bytes"] > 0
        assert cells[f"{method} {name}@24 4steps seed=0"]["forecast_seconds"] > 0
    build_study_report(folder)
    found = _verdicts(folder)
    for method in METHODS:
        outcomes = {rule: found[f"{method} {name}@24 4steps seed=0", rule]["outcome"] for rule in ("budget", "finite", "late")}
        assert outcomes == dict.fromkeys(outcomes, "ok"), method
        # Fits that share a process share what it has freed: only a fit in its own can be held to its forecast.
        assert found[f"{method} {name}@24 4steps seed=0", "memory"]["outcome"] in ("ok", "red")
    assert found[failed[0].label, "finite"]["outcome"] == "red"
    text = (folder / "index.html").read_text() + (folder / "index.md").read_text() + (folder / "results.csv").read_text()
    assert "1 skipped" in text and "Skipped: gone is not in $TOY_DATA." in text
    assert str(toy_folder) not in text


def test_finished_cells_are_kept_when_the_code_has_changed(in_process, gauntlet, monkeypatch, toy_folder: Path) -> None:
    """Only if that is asked for; a cell whose recipe changed is another cell."""
    request = replace(gauntlet, cells="splatting/* *")
    ablate(request, _yes)
    assert len(in_process.made) == 3
    monkeypatch.setattr("invgraphics.experiments.identity.code_version", lambda: "later")
    in_process.made.clear()
    ablate(replace(request, keep=True), _yes)
    assert in_process.made == []
    monkeypatch.delenv("TOY_DATA")  # what is finished needs no data
    ablate(replace(request, keep=True), _yes)
    statuses = [cell["status"] for label, cell in _cells(request).items() if label.startswith("splatting")]
    assert statuses == ["done"] * 3
    monkeypatch.setenv("TOY_DATA", str(toy_folder.parent))
    ablate(request, _yes)
    assert len(in_process.made) == 3
    source = Path(request.study)
    source.write_text(
        source.read_text().replace('"splatting/gaussians:field.count" = 150', '"splatting/gaussians:field.count" = 140')
    )
    in_process.made.clear()
    ablate(replace(request, keep=True), _yes)
    assert len(in_process.made) == 3


def test_cells_that_are_left_out_stay_what_they_were(in_process, gauntlet, toy_folder: Path) -> None:
    request = gauntlet
    seen: list[Forecast] = []
    ablate(replace(request, cells=f"splatting/* {toy_folder.name}@16 *"), seen.append)
    assert (seen[0].runs, seen[0].missing, seen[0].later) == (8, 1, 7) and "7 left out" in str(seen[0])
    ablate(replace(request, cells="splatting/* 2steps *"), _yes)
    assert len(in_process.made) == 2
    statuses = [cell["status"] for cell in _cells(request).values()]
    assert sorted(statuses) == ["done"] * 2 + ["missing"] * 5 + ["skipped"]
    with pytest.raises(InputError, match="No cell of the study is left"):
        ablate(replace(request, cells="hybrid/*"), _yes)


def test_cheap_cells_come_first(in_process, gauntlet) -> None:
    """Within a method, at one size, whose steps cost the same: fewer steps first."""
    ablate(replace(gauntlet, cells="splatting/* *"), _yes)
    plan = {planned.fit.out: planned for planned in make_plan(read_study(Path(gauntlet.study)), gauntlet)}
    made = [(plan[out].fit.budget, plan[out].fit.size) for out in in_process.made]
    assert sorted(made) == [("2steps", 16), ("2steps", 24), ("4steps", 24)]
    assert made.index(("2steps", 24)) < made.index(("4steps", 24))


@pytest.fixture
def study(tmp_path: Path):
    def read(text: str):
        (tmp_path / "trial.toml").write_text(text)
        return read_study(tmp_path / "trial.toml")

    return read


def test_listed_cells_say_where_they_hold_and_how(study) -> None:
    cells = '[[cells]]\nscenes = ["b"]\nmethods = ["volumetric/hash"]\nseeds = [1]\nsize = [40, 30]\nbudget = "9s"\n'
    cells += '[[cells]]\npreset = "laptop"\n[[cells]]\npreset = "paper"\nscenes = ["a"]\nseeds = [0]\n'
    with pytest.raises(InputError, match="cell 1 has no 'preset'"):
        study(LIST + cells)
    found = study(LIST + cells + '[base]\npreset = "laptop"\n')
    fits = [found.fit_request(cell, AblateRequest(study="trial", out="o")) for cell in found.expand()]
    assert len(fits) == 1 + 2 * 2 * 2 + 2 and all(fit.overrides == () for fit in fits)
    (special,) = [fit for fit in fits if fit.budget == "9s"]
    assert (special.scene, special.method, special.seed, special.size) == ("b", "volumetric/hash", 1, (40, 30))
    assert {fit.size for fit in fits if fit is not special} == {64}
    assert sorted((fit.scene, fit.seed) for fit in fits if fit.preset == "paper") == [("a", 0)] * 2


@pytest.mark.parametrize(
    ("cells", "sentence"),
    [
        ('[[cells]]\nscenes = ["c"]\n', "cell 1 names 'c', which is none of the study's scenes"),
        ("[[cells]]\nseeds = []\n", "cell 1 has no list of 'seeds'"),
        ('[[cells]]\nmethods = "volumetric/hash"\n', "cell 1 has no list of 'methods'"),
        ("[[cells]]\nsize = 0\n", "'size' cannot be 0"),
        ("[[cells]]\nsize = [4, 5, 6]\n", r"'size' cannot be \[4, 5, 6\]"),
        ("[[cells]]\npreset = 3\n", "'preset' cannot be 3"),
        ('[[cells]]\nbudget = "soon"\n', "'soon' is not a budget"),
        ('[[cells]]\nsize = 9\n[[known]]\ncells = "*"\nrule = "speed"\ncause = "?"\n', "'known.0.rule' cannot be 'speed'"),
    ],
)
def test_bad_lists_are_refused(study, cells: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        study(LIST + cells)


def test_the_command_line_does_not_overrule_what_cells_say(study) -> None:
    found = study(LIST + "[[cells]]\nsize = 9\nseeds = [0]\n")
    for name, value in (("size", 8), ("seeds", (0,))):
        with pytest.raises(InputError, match=f"--{name}"):
            with_request(found, AblateRequest(study="trial", out="o", **{name: value}))


def test_the_gauntlet_covers_what_it_says(tmp_path: Path) -> None:
    """Eight methods; each at 800 px for 20 minutes; each scene at each size; pairs of budgets; six hours and a half."""
    request = AblateRequest(study="gauntlet", out=str(tmp_path))
    plan = make_plan(read_study(locate("gauntlet")), request)
    cells = [(p.cell.method, p.cell.scene_name, p.fit.size, Budget.parse(p.fit.budget).seconds) for p in plan]
    assert len(set(cells)) == len(cells) == len({p.id for p in plan})
    methods, scenes = {cell[0] for cell in cells}, {cell[1] for cell in cells}
    assert len(methods) == 8 and len(scenes) >= 10
    assert {cell[0] for cell in cells if cell[2:] == (800, 1200.0)} == methods
    assert {cell[1:3] for cell in cells} >= {(scene, size) for scene in scenes for size in (128, 400, 800)}
    budgets: dict[tuple, set[float]] = {}
    for *fit, seconds in cells:
        budgets.setdefault(tuple(fit), set()).add(seconds)
    assert {fit[0] for fit, found in budgets.items() if len(found) > 1} == methods
    assert sum(len(found) == 3 for found in budgets.values()) >= 4
    hours = sum(cell[3] for cell in cells) / 3600
    assert 5 < hours < 7
    assert all(p.fit.preset is None and p.fit.test_views == 8 for p in plan)
    minute = select(plan, replace(request, most_seconds=60))
    assert {p.fit.budget for p in minute} == {"60s"} and {p.cell.method for p in minute} == methods
