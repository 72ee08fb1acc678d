"""Run folders: complete, resumable after any kind of death, honest about what they hold."""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_fixtures import SMALL

from invgraphics.core import Model, Points, Scene
from invgraphics.errors import InputError
from invgraphics.experiments import evaluate
from invgraphics.experiments import run as module
from invgraphics.experiments.evaluate import evaluate_run
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.identity import check_replaceable, run_digest, truth_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.runs.checkpoint import load, save
from invgraphics.runs.folder import CHECKPOINT, RunFolder
from invgraphics.runs.schema import plain
from invgraphics.scenes.open import SceneOptions, open_scene

METHOD = "splatting/gaussians"
LONG = 300
"""Steps of a fit that is interrupted: more than fit into the time until the signal."""


def _request(toy_folder: Path, out: Path, **more) -> FitRequest:
    base = {"method": METHOD, "scene": str(toy_folder), "out": str(out), "budget": "30steps", "overrides": tuple(SMALL[METHOD])}
    return FitRequest(**base | more)


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fit_run(_request(toy_folder, tmp_path_factory.mktemp("runs") / "a"))


def _same_checkpoint(a: Path, b: Path) -> bool:
    return (a / CHECKPOINT).read_bytes() == (b / CHECKPOINT).read_bytes()


def test_a_run_is_whole(run: Path) -> None:
    scores = json.loads((run / "scores.json").read_text())
    assert scores["method"] == METHOD and scores["protocol"] == "default"
    for metric in ("psnr", "ssim", "flip", "alpha_iou"):
        entry = scores["quality"][metric]
        assert len(entry["per_view"]) == len(scores["views"]) == 3
        assert entry["mean"] == pytest.approx(np.mean(entry["per_view"]))
    assert scores["cost"]["steps"] == 30
    assert scores["cost"]["primitives"] > 0
    assert all(
        scores["cost"][key] > 0
        for key in ("fit_seconds", "fit_cpu_seconds", "render_fps", "model_bytes", "parameters", "peak_memory_bytes")
    )
    shares = [scores["cost"][key] for key in ("fit_processor_share", "render_processor_share")]
    assert all(share is None or 0 < share <= 1 for share in shares)
    assert ("disturbed" in scores) == any(share is not None and share < 0.85 for share in shares)
    history = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    assert history[0]["step"] == 0 and history[-1]["step"] == 30
    assert all(a["seconds"] <= b["seconds"] for a, b in itertools.pairwise(history))
    provenance = json.loads((run / "provenance.json").read_text())
    assert provenance["threads"] == torch.get_num_threads()
    assert set(provenance["load_average"]) == {"start", "end"}
    assert "spp" not in provenance["options"]
    truth = run / provenance["truth"]
    assert len(list(truth.glob("*.png"))) == 3
    assert provenance["command"].startswith("invgraphics fit splatting/gaussians")
    assert json.loads((run / "environment.json").read_text())["deterministic"] is True


def test_what_an_import_suspects_is_repeated_before_the_fit(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    suspect = {"inconsistent_poses": "3 of 9 contradict"}
    scene = open_scene(str(toy_folder), SceneOptions())
    monkeypatch.setattr(module, "open_with_progress", lambda *_: replace(scene, notes=scene.notes | suspect))
    out = fit_run(_request(toy_folder, tmp_path / "run", budget="2steps"))
    assert "SUSPICIOUS poses: 3 of 9 contradict" in capsys.readouterr().err
    assert json.loads((out / "provenance.json").read_text())["notes"]["inconsistent_poses"] == "3 of 9 contradict"


def test_scores_can_be_recomputed_from_the_saved_pictures(run: Path) -> None:
    """PSNR straight from the two PNG files equals the score: evaluation hides nothing."""
    scores = json.loads((run / "scores.json").read_text())
    truth = run / json.loads((run / "provenance.json").read_text())["truth"]
    for index, expected in enumerate(scores["quality"]["psnr"]["per_view"]):
        a, b = (np.asarray(Image.open(folder / f"{index:04d}.png"), np.float64) / 255 for folder in (run / "test", truth))
        assert -10 * np.log10(((a - b) ** 2).mean()) == pytest.approx(expected, abs=1e-4)


def test_evaluating_again_gives_the_same_scores(run: Path) -> None:
    before = json.loads((run / "scores.json").read_text())["quality"]
    assert plain(evaluate_run(run))["quality"] == before


def test_other_test_views_than_the_run_s_are_refused(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    """In a capture that has grown, they may be photographs that the run was fitted to."""
    before = (run / "scores.json").read_bytes()
    copy = Path(shutil.copytree(toy_folder, tmp_path / "copy"))
    assert plain(evaluate_run(run, str(copy)))["quality"] == json.loads(before)["quality"]
    scored, fitted = (sorted((copy / split).glob("*.png"))[0] for split in ("test", "train"))
    shutil.copy(fitted, scored)
    before = (run / "scores.json").read_bytes()
    with pytest.raises(InputError, match="it may have been fitted to these"):
        evaluate_run(run, str(copy))
    assert (run / "scores.json").read_bytes() == before


@pytest.mark.parametrize(("normals", "colour_only", "whole"), [(True, 2, 3), (False, 3, 0)])
def test_timing_costs_few_pictures_more_where_normals_are_scored(
    run: Path, monkeypatch: pytest.MonkeyPatch, normals: bool, colour_only: int, whole: int
) -> None:
    """Normals make a picture dearer than a viewer's, so a picture without them is timed beside it, for some views."""
    fitted, asked, plain = open_fitted(run), [], Model.render

    def counted(model, camera, *, normals=True):
        if camera.width == fitted.scene.test[0].camera.width:
            asked.append(normals)
        return plain(model, camera, normals=normals)

    monkeypatch.setattr(Model, "render", counted)
    monkeypatch.setattr(evaluate, "TIMED", 2)
    up = torch.tensor([0.0, 0.0, 1.0])
    views = tuple(replace(view, normal=up.expand(*view.image.shape) if normals else None) for view in fitted.scene.test)
    scores = evaluate.evaluate(fitted.folder, replace(fitted.scene, test=views), fitted.model, "float", {}, fitted.method)
    assert (asked.count(False), asked.count(True)) == (colour_only, whole)
    assert scores.cost["render_fps"] > 0


def test_same_seed_gives_the_same_bits(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    again = fit_run(_request(toy_folder, tmp_path / "b"))
    assert _same_checkpoint(run, again)


def test_another_protocol_scores_the_same_fit(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    """A finished fit is not made again, nor lost, because its pictures are to be judged otherwise."""
    folder = shutil.copytree(run, tmp_path / "run")
    checkpoint, scores = ((folder / name).read_bytes() for name in ("checkpoint.safetensors", "scores.json"))
    first = json.loads((folder / "fit.json").read_text())
    fit_run(replace(_request(toy_folder, folder), protocol="float", existing="reuse"))
    assert (folder / "checkpoint.safetensors").read_bytes() == checkpoint
    assert json.loads((folder / "fit.json").read_text()) == first
    assert (folder / "scores.json").read_bytes() == scores
    other = json.loads((folder / "scores.float.json").read_text())
    assert other["protocol"] == "float" and other["views"] == json.loads(scores)["views"]


@pytest.mark.parametrize(("changes", "threads", "said"), [({"device": "cuda"}, None, "device"), ({}, 3, "number of threads")])
def test_a_fit_on_another_machine_is_not_replaced_unasked(
    run: Path, toy_folder: Path, tmp_path: Path, changes: dict[str, str], threads: int | None, said: str
) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    record = json.loads((folder / "provenance.json").read_text())
    (folder / "provenance.json").write_text(json.dumps(record | changes))
    job = Job.of(_request(toy_folder, folder))
    with pytest.raises(InputError, match=f"holds another run: its {said} is"):
        check_replaceable(job, threads)
    (folder / "provenance.json").write_text(json.dumps(record | {"budget": "imported"}))
    with pytest.raises(InputError, match="holds another run: its budget is imported, not 30 steps"):
        check_replaceable(job)
    check_replaceable(Job.of(_request(toy_folder, run)), torch.get_num_threads())


def test_a_field_that_starts_from_a_changed_file_is_another_fit(toy_folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "hull.ply"
    request = replace(_request(toy_folder, tmp_path / "run"), method="surface/mesh", overrides=(f"field.source={source}",))
    found = []
    for content in (b"one", b"two", b"one"):
        source.write_bytes(content)
        found.append(run_digest(Job.of(request), "truth", 1))
    assert found[0] == found[2] != found[1]


def test_whatever_a_fit_may_read_identifies_it(scene: Scene) -> None:
    """Masks, depth, points, bounds and background, which neither pixels nor cameras tell; names and notes do not matter."""
    first, *others = scene.train
    points = Points(torch.zeros(2, 3), torch.ones(2, 3))
    known = replace(scene, points=points)
    changed = [
        known.with_views(train=(replace(first, mask=torch.ones(first.image.shape[:2], dtype=torch.bool)), *others)),
        known.with_views(train=(replace(first, depth=torch.ones(first.image.shape[:2])), *others)),
        replace(known, points=replace(points, position=torch.full((2, 3), 1e-6))),
        replace(known, points=None),
        replace(known, bounds=replace(scene.bounds, near=0.1)),
        replace(known, background=1 - scene.background),
    ]
    digests = [truth_digest(one) for one in (known, *changed)]
    assert len(set(digests)) == len(digests)
    assert len({(one.digest("train"), one.digest("test"), one.camera_digest()) for one in (known, *changed)}) == 1
    renamed = known.with_views(train=(replace(first, name="other"), *others))
    assert truth_digest(replace(renamed, name="copy", notes={"resize": "none"}, noise_ceiling=40.0)) == digests[0]


def test_spelling_makes_no_other_run(run: Path, toy_folder: Path) -> None:
    request = _request(toy_folder, run)
    spelt = replace(request, device="cpu", budget=f" {request.budget.replace('steps', ' steps')}")
    assert spelt.budget != request.budget
    assert run_digest(Job.of(spelt), "truth", 1) == run_digest(Job.of(request), "truth", 1)
    check_replaceable(Job.of(spelt))
    for scene in (f"{toy_folder}/", os.path.relpath(toy_folder), f"{toy_folder}/../{toy_folder.name}"):
        check_replaceable(Job.of(replace(request, scene=scene)))
    with pytest.raises(InputError, match="its scene is"):
        check_replaceable(Job.of(replace(request, scene=str(toy_folder.parent))))


def test_a_refused_fit_leaves_no_run_behind(toy_folder: Path, tmp_path: Path) -> None:
    """What the first step refuses is no run that would block the folder for the corrected request; nor is a missing scene."""
    wrong = _request(toy_folder, tmp_path / "run", overrides=(*SMALL[METHOD], "losses.0.type=eikonal"))
    with pytest.raises(InputError, match="needs samples with gradients"):
        fit_run(wrong)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError):
        fit_run(_request(toy_folder / "nothing", tmp_path / "other"))
    assert not (tmp_path / "other").exists()
    assert fit_run(_request(toy_folder, tmp_path / "run", budget="2steps")).is_dir()


@pytest.mark.parametrize(
    ("method", "losses", "idle"),
    [
        (
            "splatting/gaussians",
            '[{type="photometric"}, {type="distortion"}, {type="interlevel"}]',
            ["distortion", "interlevel"],
        ),
        ("volumetric/hash", '[{type="photometric"}, {type="scale"}, {type="coarse"}]', ["scale", "coarse"]),
        ("volumetric/hash", '[{type="photometric"}, {type="distortion"}, {type="mask"}]', []),
    ],
)
def test_losses_that_have_nothing_to_act_on_are_named(
    toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str, losses: str, idle: list[str]
) -> None:
    changes = (*SMALL.get(method, ()), f"losses={losses}")
    fit_run(_request(toy_folder, tmp_path / "run", method=method, budget="1steps", overrides=changes))
    lines = [line for line in capsys.readouterr().err.splitlines() if "is 0 throughout" in line]
    assert [line.split("'")[1] for line in lines] == idle


@pytest.mark.parametrize(("losses", "said"), [('[{type="scale"}]', "nothing to fit by"), ('[{type="ssim"}]', "whole images")])
def test_a_fit_without_an_objective_is_refused(toy_folder: Path, tmp_path: Path, losses: str, said: str) -> None:
    request = _request(toy_folder, tmp_path / "run", method="volumetric/hash", overrides=(f"losses={losses}",))
    with pytest.raises(InputError, match=said):
        fit_run(request)


def test_existing_runs_are_not_overwritten(run: Path, toy_folder: Path) -> None:
    with pytest.raises(InputError, match="holds this fit, finished"):
        fit_run(_request(toy_folder, run))
    with pytest.raises(InputError, match="holds another run: its seed is 0, not 5"):
        fit_run(_request(toy_folder, run, seed=5, existing="resume"))
    with pytest.raises(InputError, match="holds another run: its budget is 30 steps, not 31 steps"):
        fit_run(_request(toy_folder, run, budget="31steps", existing="resume"))
    with pytest.raises(InputError, match="holds no run to resume"):
        fit_run(_request(toy_folder, run.parent / "nothing", existing="resume"))
    stamp = (run / "scores.json").stat().st_mtime_ns
    fit_run(_request(toy_folder, run, existing="reuse"))
    assert (run / "scores.json").stat().st_mtime_ns == stamp


def test_an_unfinished_run_says_how_it_goes_on(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "scores.json").unlink()
    with pytest.raises(InputError, match=r"holds this fit, unfinished\.\nAdd --resume"):
        fit_run(_request(toy_folder, folder))


def test_a_renamed_method_is_named(run: Path, toy_folder: Path) -> None:
    """The same recipe, with a setting in the method's name rather than beside it, has another identity."""
    first, *rest = SMALL[METHOD]
    with pytest.raises(InputError, match=f"a run called '{METHOD}', not '{METHOD}:{first}'"):
        fit_run(_request(toy_folder, run, method=f"{METHOD}:{first}", overrides=tuple(rest), existing="resume"))


def test_snapshots_of_a_lost_end_are_removed(toy_folder: Path, tmp_path: Path) -> None:
    """A fit killed after its last checkpoint has written snapshots of steps that the resumed fit takes anew."""
    folder = RunFolder(fit_run(_request(toy_folder, tmp_path / "run", snapshots=2)))
    kept = {path: path.read_bytes() for path in folder.snapshots}
    assert len(kept) == 3
    lost, broken = folder.snapshot(7), folder.snapshot(8)
    save(lost, load(folder.snapshots[-1]) | {"fit": {"steps": torch.tensor(31)}})
    broken.write_bytes(b"broken")
    (folder.root / "scores.json").unlink()
    fit_run(_request(toy_folder, folder.root, snapshots=2, existing="resume"))
    assert {path: path.read_bytes() for path in folder.snapshots} == kept


def test_a_resumed_fit_keeps_its_peak_memory(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    """What is left to do, here the scores alone, needs less than what was done before."""
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "scores.json").unlink()
    record = json.loads((folder / "fit.json").read_text())
    (folder / "fit.json").write_text(json.dumps(record | {"peak_memory_bytes": 10**12}))
    fit_run(_request(toy_folder, folder, existing="resume"))
    assert json.loads((folder / "scores.json").read_text())["cost"]["peak_memory_bytes"] == 10**12
    assert json.loads((folder / "fit.json").read_text())["peak_memory_bytes"] == 10**12


def test_steps_whose_clock_was_lost_count_all_the_same(
    run: Path, toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A kill between the writing of checkpoint and clocks: the budget is that of all steps, and it is said."""
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "scores.json").unlink()
    record = json.loads((folder / "fit.json").read_text())
    known = {"steps": 10, "seconds": 40.0, "cpu_seconds": 60.0, "ran_seconds": 50.0, "waited_seconds": 1.0}
    (folder / "fit.json").write_text(json.dumps(record | known))
    fit_run(_request(toy_folder, folder, existing="resume"))
    after, cost = (json.loads((folder / name).read_text()) for name in ("fit.json", "scores.json"))
    assert after["steps"] == 30 and after["seconds"] == pytest.approx(120.0) and cost["cost"]["fit_seconds"] == after["seconds"]
    assert after["cpu_seconds"] == pytest.approx(180.0) and after["ran_seconds"] >= 150.0 and after["waited_seconds"] >= 3.0
    assert "the times of steps 10 to 30 of" in capsys.readouterr().err


def test_a_fit_that_goes_on_elsewhere_keeps_where_it_began(
    run: Path, toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    path, here = folder / "environment.json", json.loads((run / "environment.json").read_text())
    path.write_text(json.dumps(here | {"cpu": "An abacus", "cores": 3, "date": "1623-01-01 00:00 UTC"}))
    for _ in range(2):  # the second time nothing has changed
        (folder / "scores.json").unlink()
        fit_run(_request(toy_folder, folder, existing="resume"))
        found = json.loads(path.read_text())
        assert found["cpu"] == here["cpu"] and len(found["begun_on"]) == 1
        assert found["begun_on"][0].startswith("An abacus, 3 cores") and here["torch"] in found["begun_on"][0]
    assert capsys.readouterr().err.count("the fit was begun elsewhere (An abacus, 3 cores") == 1


def test_a_fit_goes_on_by_other_code_where_that_is_asked_for(
    run: Path, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fit that stopped in a faulty hook, say, goes on once that is mended; its record names the code before."""
    folder, before = shutil.copytree(run, tmp_path / "run"), json.loads((run / "provenance.json").read_text())
    (folder / "scores.json").unlink()
    for user in ("identity", "run", "environment"):
        monkeypatch.setattr(f"invgraphics.experiments.{user}.code_version", lambda: "9.9+later")
    with pytest.raises(InputError, match=r"from another source: it was made by .*; this is .*, \d+ threads?\.\nAdd --keep"):
        fit_run(_request(toy_folder, folder, existing="resume"))
    record = json.loads((folder / "provenance.json").read_text())
    (folder / "provenance.json").write_text(json.dumps(record | {"train_sha256": "0" * 64}))
    with pytest.raises(InputError, match="holds a run of other pictures of the same scene"):
        fit_run(_request(toy_folder, folder, existing="resume", keep=True))
    (folder / "provenance.json").write_text(json.dumps(record))
    for _ in range(2):  # the second time the code is the same
        fit_run(_request(toy_folder, folder, existing="resume", keep=True))
        found = json.loads((folder / "environment.json").read_text())
        assert len(found["begun_on"]) == 1
        assert re.fullmatch(rf"code: invgraphics {re.escape(before['code_version'])}, \d+ threads?", found["begun_on"][0])
        (folder / "scores.json").unlink()
    after = json.loads((folder / "provenance.json").read_text())
    assert after["code_version"] == "9.9+later" and after["cell_sha256"] != before["cell_sha256"]
    assert capsys.readouterr().err.count("the fit was begun by other code, threads or packages (invgraphics ") == 1


def test_a_checkpoint_that_other_code_cannot_read_is_refused(
    run: Path, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "scores.json").unlink()
    state = load(folder / CHECKPOINT)
    name = next(key for key in state["field"] if state["field"][key].ndim > 1)
    save(folder / CHECKPOINT, state | {"field": state["field"] | {name: state["field"][name][..., :1]}})
    monkeypatch.setattr("invgraphics.experiments.identity.code_version", lambda: "9.9+later")
    with pytest.raises(InputError, match=f"does not fit the code of today: .*{name}"):
        fit_run(_request(toy_folder, folder, existing="resume", keep=True))


def _spawn(request: FitRequest, folder: Path) -> subprocess.Popen:
    job = folder / "job.json"
    job.write_text(json.dumps(request.to_json()))
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    return subprocess.Popen([sys.executable, "-m", "invgraphics.experiments.run", str(job)], env=environment)


def _wait_for(path: Path, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not path.is_file() and time.monotonic() < end:
        time.sleep(0.02)
    assert path.is_file(), f"{path.name} never appeared"


@pytest.fixture(scope="module")
def long_run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted: the judge of those that something did."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    return fit_run(_request(toy_folder, out, budget=f"{LONG}steps", checkpoint_every="1000s"))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_run_resumes_to_the_same_bits(long_run: Path, toy_folder: Path, tmp_path: Path, number: int) -> None:
    request = _request(toy_folder, tmp_path / "run", budget=f"{LONG}steps", checkpoint_every="1steps")
    process = _spawn(request, tmp_path)
    _wait_for(tmp_path / "run" / "fit.json")
    time.sleep(0.2)
    process.send_signal(number)
    status = process.wait(timeout=60)
    assert status == (-9 if number == signal.SIGKILL else 130)
    steps = int(load(tmp_path / "run" / CHECKPOINT)["fit"]["steps"])
    assert 0 < steps < LONG
    assert not (tmp_path / "run" / "scores.json").exists()
    fit_run(replace(request, existing="resume", checkpoint_every="1000s"))
    assert _same_checkpoint(tmp_path / "run", long_run)
    lines = [json.loads(line)["step"] for line in (tmp_path / "run" / "history.jsonl").read_text().splitlines()]
    assert lines == sorted(set(lines))


def test_a_full_disk_is_said_and_keeps_the_last_checkpoint(toy_folder: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    if (
        os.geteuid() != 0
        or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=700k", "tmpfs", str(small)], check=False).returncode
    ):
        pytest.skip("mounting a small tmpfs needs root")
    try:
        (small / "ballast").write_bytes(b"x" * 550_000)
        request = _request(toy_folder, small / "run", budget="400steps", checkpoint_every="1steps")
        process = _spawn(request, tmp_path)
        assert process.wait(timeout=120) == 1
        error = json.loads((tmp_path / "job.error.json").read_text())
        assert "cannot be written: the disk is full" in error["error"] and str(small / "run") in error["error"]
        assert not list((small / "run").glob("*.tmp"))
        assert int(load(small / "run" / CHECKPOINT)["fit"]["steps"]) > 0
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_a_fit_that_fails_unexpectedly_leaves_the_kind_of_its_error(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report's line of a failed fit is all that its reader sees: the text of a KeyError alone is a name in quotes."""

    def fail(request: FitRequest) -> Path:
        raise KeyError("means")

    monkeypatch.setattr(module, "fit_run", fail)
    (tmp_path / "job.json").write_text(json.dumps(_request(toy_folder, tmp_path / "run").to_json()))
    assert module.work(tmp_path / "job.json") == 1
    said = json.loads((tmp_path / "job.error.json").read_text())["error"]
    assert said == "Unexpected KeyError: 'means' (this is a fault of invgraphics, not of your input)"


def test_a_damaged_run_gets_a_sentence(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is not a run|is missing"):
        evaluate_run(tmp_path)
    (tmp_path / "provenance.json").write_text("{")
    with pytest.raises(InputError, match="is not valid JSON"):
        evaluate_run(tmp_path)


def test_a_checkpoint_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """The library that writes it tells the system's error in words, without number and path."""
    path = tmp_path / "gone" / CHECKPOINT
    with pytest.raises(FileNotFoundError) as caught:
        save(path, {"fit": {"steps": torch.zeros(1)}})
    assert caught.value.filename == str(path)


def test_scores_of_an_interrupted_fit_would_end_it(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    """`evaluate` refuses it, and what an earlier protocol said of its checkpoint is gone once it goes on."""
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "scores.json").unlink()
    lines = (folder / "history.jsonl").read_text().splitlines()
    half = [line for line in lines if json.loads(line)["progress"] <= 0.5]
    (folder / "history.jsonl").write_text("\n".join(half) + "\n")
    with pytest.raises(InputError, match=r"is not finished: \d+% of its budget are recorded"):
        evaluate_run(folder)
    (folder / "scores.float.json").write_text("{}")
    fit_run(_request(toy_folder, folder, existing="resume"))
    assert (folder / "scores.json").is_file() and not (folder / "scores.float.json").exists()


def test_packages_and_kernels_are_part_of_a_run_s_identity(
    run: Path, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    request = _request(toy_folder, folder)
    truth = truth_digest(open_scene(str(toy_folder), SceneOptions()))
    here = run_digest(Job.of(request), truth, 2)
    named = json.loads((run / "environment.json").read_text())["kernels"]
    assert run_digest(Job.of(replace(request, kernels=named)), truth, 2) == here
    other = "reference" if named != "reference" else "numba"
    assert run_digest(Job.of(replace(request, kernels=other)), truth, 2) != here
    with pytest.raises(InputError, match=f"holds another run: its kernels is {named}, not {other}"):
        check_replaceable(Job.of(replace(request, kernels=other)))
    monkeypatch.setattr(torch, "__version__", "9.9.9")
    assert run_digest(Job.of(request), truth, 2) != here


def test_another_start_of_the_same_photographs_is_named(run: Path, toy_folder: Path) -> None:
    """`compare` may have chosen it for all methods, so that no --set of the user's made the difference."""
    changed = _request(toy_folder, run, overrides=(*SMALL[METHOD], "data.init=random"))
    with pytest.raises(InputError, match=r"its training data is .*\nAdd --set data.init=scene\."):
        check_replaceable(Job.of(changed))
