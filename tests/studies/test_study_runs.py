"""Studies as they run: each cell once, failures and interruptions survived, ``study.json`` true at any moment."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_fixtures import SMALL

from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import AblateRequest, CompareRequest, FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.studies import ablate as module
from invgraphics.studies.ablate import ablate
from invgraphics.studies.forecast import START_SECONDS, Cost, Forecast, limited_threads, total, try_method
from invgraphics.training.budget import Budget

METHOD = "splatting/gaussians"
VIEWS = "data.train_views"


class InProcess:
    """An executor that fits here and now, and does as a test wants with certain runs."""

    made: list[str]
    before: Callable[[FitRequest], None]

    def __init__(self, resources: Resources) -> None:
        assert resources.threads == torch.get_num_threads()

    def run(self, requests, jobs):
        for request in requests:
            name = Path(request.out).name
            try:
                type(self).before(request)
                fit_run(request)
            except NumericalError as error:
                yield Outcome(request, 1, str(error), 1.0)
            else:
                self.made.append(name)
                yield Outcome(request, 0, "", 1.5)


@pytest.fixture
def executor(monkeypatch) -> type[InProcess]:
    InProcess.made, InProcess.before = [], lambda request: None
    monkeypatch.setattr(module.plugins, "load", _load_instead(module.plugins.load))
    return InProcess


def _load_instead(load):
    return lambda registry, name: InProcess if registry == "executors" else load(registry, name)


@pytest.fixture
def request_of(toy_folder: Path, tmp_path: Path) -> Callable[..., AblateRequest]:
    """A study of two points and two seeds on disk."""

    def write(text: str = f'[factors]\n"{VIEWS}" = [4, 8]\n', **more) -> AblateRequest:
        head = f'question = "Why?"\nscenes = ["{toy_folder}"]\nmethods = ["{METHOD}"]\nseeds = [0, 1]\nbudget = "2steps"\n'
        base = "".join(f"{item}\n" for item in SMALL[METHOD])
        (tmp_path / "trial.toml").write_text(head + text + ("" if "[base]" in text else "[base]\n") + base)
        return AblateRequest(study=str(tmp_path / "trial.toml"), out=str(tmp_path / "out"), kernels="reference", **more)

    return write


def _record(request: AblateRequest) -> dict:
    return json.loads((Path(request.out) / "study.json").read_text())


def _yes(forecast: Forecast) -> None:
    assert forecast.hours < 1


def test_the_time_of_pictures_by_another_kind_of_renderer_is_forecast(toy_folder: Path, tmp_path: Path) -> None:
    """A mesh is made of the field first."""
    request = FitRequest(method="volumetric/hash", scene=str(toy_folder), out=str(tmp_path / "run"), budget="2steps")
    job = Job.of(replace(request, overrides=tuple(SMALL["volumetric/hash"]), render_with=("surface/mesh",)))
    assert try_method(job, open_scene(str(toy_folder), SceneOptions())).other > START_SECONDS


def test_a_study_runs_once_and_then_does_nothing(executor, request_of) -> None:
    request = request_of()
    folder, failed = ablate(request, _yes)
    assert not failed and len(executor.made) == 4
    record = _record(request)
    assert (record["schema"], record["name"], record["design"]) == (1, "trial", "factorial")
    assert record["factors"] == {VIEWS: [4, 8]} and record["base"][VIEWS] == 4
    assert record["protocol"]["name"] == "default"
    assert record["environment"]["threads"] == torch.get_num_threads()
    for cell in record["cells"]:
        assert (cell["status"], cell.get("error"), cell["seconds"]) == ("done", None, 1.5)
        assert cell["run"] == f"runs/{cell['id']}"
        provenance = json.loads((folder / cell["run"] / "provenance.json").read_text())
        assert provenance["data"] == {"train_views": cell["levels"][VIEWS]}
        assert f"--set data.train_views={cell['levels'][VIEWS]}" in provenance["command"]
        assert len(json.loads((folder / cell["run"] / "scores.json").read_text())["views"]) == 3
    executor.made.clear()
    seen = []
    ablate(request, seen.append)
    assert not executor.made
    assert (seen[0].runs, seen[0].missing, seen[0].seconds) == (4, 0, 0)
    assert _record(request)["cells"] == record["cells"]
    assert all(word not in record["command"] for word in ("--keep", "--cells", "--most-seconds"))
    ablate(replace(request, keep=True, cells="* seed=0", most_seconds=60.0), _yes)
    assert _record(request)["command"] == record["command"]  # that of the whole study
    # More seeds: only the new cells.
    ablate(replace(request, seeds=(0, 1, 2)), _yes)
    assert len(executor.made) == 2 and all("seed=2" in name for name in executor.made)


def test_finished_fits_of_other_threads_are_not_replaced_unasked(executor, request_of, monkeypatch) -> None:
    request = request_of()
    ablate(request, _yes)
    executor.made.clear()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)  # else seven would be what is restored
    with pytest.raises(InputError, match=r"its number of threads is \d+, not 7\.\nGive the same --jobs, add --keep"):
        ablate(request, _yes)
    ablate(replace(request, keep=True), _yes)
    assert not executor.made


def test_interrupted_it_goes_on(executor, request_of) -> None:
    request = request_of()

    def interrupt(fit: FitRequest) -> None:
        if len(executor.made) == 2:
            raise KeyboardInterrupt

    executor.before = staticmethod(interrupt)
    with pytest.raises(KeyboardInterrupt):
        ablate(request, _yes)
    statuses = [cell["status"] for cell in _record(request)["cells"]]
    assert statuses == ["done", "done", "missing", "missing"]
    first = list(executor.made)
    executor.before = staticmethod(lambda fit: None)
    ablate(request, _yes)
    assert len(executor.made) == 4 == len(set(executor.made)) and executor.made[:2] == first
    assert all(cell["status"] == "done" for cell in _record(request)["cells"])


def test_a_damaged_cell_is_made_again(executor, request_of) -> None:
    request = request_of()
    folder, _ = ablate(request, _yes)
    victims = [folder / cell["run"] for cell in _record(request)["cells"]][:2]
    (victims[0] / "scores.json").unlink()
    provenance = json.loads((victims[1] / "provenance.json").read_text()) | {"cell_sha256": "of other code"}
    (victims[1] / "provenance.json").write_text(json.dumps(provenance))
    executor.made.clear()
    ablate(request, _yes)
    assert executor.made == [victim.name for victim in victims]


def test_a_failing_cell_is_recorded_and_the_others_go_on(executor, request_of) -> None:
    request = request_of()

    def fail(fit: FitRequest) -> None:
        if fit.seed == 1 and f"{VIEWS}=4" in fit.overrides:
            raise NumericalError("Step 3: the loss is not finite.")

    executor.before = staticmethod(fail)
    _, failed = ablate(request, _yes)
    assert [(cell.seed, cell.levels[VIEWS], cell.error) for cell in failed] == [(1, 4, "Step 3: the loss is not finite.")]
    assert [cell["status"] for cell in _record(request)["cells"]].count("done") == 3
    executor.before = staticmethod(lambda fit: None)
    executor.made.clear()
    assert ablate(request, _yes)[1] == [] and len(executor.made) == 1


def test_a_run_that_two_cells_share_is_made_once(executor, request_of) -> None:
    """Two spellings of one budget define the same run."""
    text = 'seeds = [0]\ndesign = "list"\n[[cells]]\n"batches.views" = 32\n[[cells]]\n"batches.views" = 32\nbudget = "2steps"\n'
    text += '[[cells]]\n"batches.views" = 31\n[base]\nbudget = "2 steps"\n'
    request = request_of()
    source = Path(request.study)
    source.write_text(source.read_text().split("seeds")[0] + text + "".join(f"{item}\n" for item in SMALL[METHOD]))
    ablate(request, _yes)
    cells = _record(request)["cells"]
    assert len(cells) == 3 and len(executor.made) == 2
    assert cells[0]["run"] == cells[1]["run"] != cells[2]["run"]
    assert all(cell["status"] == "done" for cell in cells)


def test_nothing_is_run_when_it_is_called_off(executor, request_of) -> None:
    request = request_of()

    def no(forecast: Forecast) -> None:
        raise InputError("No.")

    with pytest.raises(InputError, match="No"):
        ablate(request, no)
    assert not executor.made and not (Path(request.out) / "study.json").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (f'[factors]\n"{VIEWS}" = [4, 99]\n', "99, but"),
        ('[factors]\n"data.size" = [12, 48]\n', "48, but"),
    ],
)
def test_levels_that_a_scene_cannot_give_are_refused_before_the_first_run(executor, request_of, text, sentence) -> None:
    with pytest.raises(InputError, match=sentence):
        ablate(request_of(text), _yes)
    assert not executor.made


def test_unknown_things_are_refused_before_the_first_run(request_of) -> None:
    request = request_of()
    with pytest.raises(InputError, match="no 'cloud' among the executors"):
        ablate(replace(request, executor="cloud"), _yes)
    source = Path(request.study)
    source.write_text(source.read_text().replace('scenes = ["', 'scenes = ["/nowhere'))
    with pytest.raises(InputError, match="neither a built-in scene nor an existing path"):
        ablate(request, _yes)


def test_one_folder_holds_one_study(executor, request_of, tmp_path: Path) -> None:
    request = request_of(seeds=(0,))
    ablate(request, _yes)
    shutil.copy(request.study, tmp_path / "another.toml")
    with pytest.raises(InputError, match="holds the study 'trial'"):
        ablate(replace(request, study=str(tmp_path / "another.toml")), _yes)


def test_a_published_report_is_not_replaced(executor, request_of) -> None:
    """Its runs are elsewhere: the page and its figures are all there is."""
    request = request_of()
    Path(request.out).mkdir()
    (Path(request.out) / "index.html").write_text("")
    with pytest.raises(InputError, match="holds a published report, which would be replaced"):
        ablate(request, _yes)
    assert not executor.made and [path.name for path in Path(request.out).iterdir()] == ["index.html"]


def test_a_study_that_the_disk_cannot_hold_is_not_started(executor, request_of, monkeypatch) -> None:
    usage = shutil.disk_usage(".")
    monkeypatch.setattr(module.shutil, "disk_usage", lambda folder: usage._replace(free=10))
    with pytest.raises(InputError, match=r"The study will write .* GB left"):
        ablate(request_of(), _yes)
    assert not executor.made


def test_the_forecast_adds_up() -> None:
    slow, fast = Cost(step=0.5, other=10.0, size=4 * 10**9), Cost(step=0.1, other=5.0, size=10**9)
    costs = [(slow, Budget.parse("1h")), (slow, Budget.parse("100steps")), (fast, Budget.parse("60s"))]
    forecast = total(costs, runs=7, jobs=2)
    assert forecast.seconds == (3600 + 10 + 50 + 10 + 60 + 5) / 2
    assert (forecast.runs, forecast.missing, forecast.size) == (7, 3, 9 * 10**9)
    assert str(forecast) == "7 runs, 4 of them finished; the rest takes about 31 min 8 s and 9 GB."
    shown = total([(slow, None)], runs=7, jobs=1, later=2)  # fitted, and to be shown by another renderer
    assert str(shown) == "7 runs, 4 of them finished, 2 left out; the rest takes about 10 s and 4 GB."


def test_what_a_command_leaves_out_is_counted_as_such(executor, request_of) -> None:
    forecasts = []
    ablate(request_of(cells="* seed=0"), forecasts.append)
    assert (forecasts[0].runs, forecasts[0].missing, forecasts[0].later) == (4, 2, 2)
    ablate(request_of(), forecasts.append)
    assert (forecasts[1].runs, forecasts[1].missing, forecasts[1].later) == (4, 2, 0)


def test_costs_are_measured_with_a_run_s_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr(torch, "set_num_threads", counts.append)
    with limited_threads(3):
        assert counts == [3]
    assert counts == [3, 8]


def test_training_data_has_the_same_door_in_fit_and_compare(toy_folder: Path, tmp_path: Path) -> None:
    """Scores and truth are of untouched test views; the fit sees the disturbed photographs."""
    shared = {"method": METHOD, "scene": str(toy_folder), "budget": "2steps", "kernels": "reference"}
    runs = {}
    for name, items in {"plain": (), "noisy": ("data.photo_noise=0.2", "data.background=black")}.items():
        request = FitRequest(**shared | {"out": str(tmp_path / name), "overrides": (*SMALL[METHOD], *items)})
        runs[name] = json.loads((fit_run(request) / "provenance.json").read_text())
    plain, noisy = runs["plain"], runs["noisy"]
    assert plain["truth_sha256"] == noisy["truth_sha256"] and plain["background"] == noisy["background"] == [1, 1, 1]
    assert plain["train_sha256"] != noisy["train_sha256"] and plain["cell_sha256"] != noisy["cell_sha256"]
    assert "data" not in plain and noisy["data"] == {"photo_noise": 0.2, "background": "black"}
    assert "--set data.photo_noise=0.2" in noisy["command"]
    comparison = CompareRequest(scene=str(toy_folder), out=str(tmp_path), methods=(METHOD,), overrides=("data.size=12",))
    assert [fit.data_overrides for fit in comparison.fits()] == [("data.size=12",)]
    with pytest.raises(InputError, match=r"Unknown key 'data\.siez'"):
        fit_run(FitRequest(**shared | {"out": str(tmp_path / "typo"), "overrides": ("data.siez=12",)}))


def test_another_protocol_leaves_a_finished_run(toy_folder: Path, tmp_path: Path) -> None:
    shared = {"method": METHOD, "scene": str(toy_folder), "budget": "2steps", "kernels": "reference"}
    request = FitRequest(**shared | {"out": str(tmp_path / "r"), "overrides": tuple(SMALL[METHOD]), "protocol": "float"})
    folder = fit_run(replace(request, existing="reuse"))
    assert json.loads((folder / "scores.float.json").read_text())["protocol"] == "float"
    stamp = (folder / "scores.json").stat().st_mtime_ns
    fit_run(replace(request, existing="reuse"))
    assert (folder / "scores.json").stat().st_mtime_ns == stamp
