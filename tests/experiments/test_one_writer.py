"""One process writes an output at a time, a second one is refused and told who writes; what is finished is not erased."""

import fcntl
import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from processes import Running
from training_fixtures import SMALL

from invgraphics import locks
from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import save_truth
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.experiments.start import remove_empty
from invgraphics.report.data.assets import LOCK
from invgraphics.runs.folder import RunFolder
from invgraphics.scenes.mitsuba import cache
from invgraphics.scenes.photos import PhotoJob
from invgraphics.scenes.photos.maker import JOB, WORK, reconstruct
from invgraphics.testing import toy_scene

METHOD = "splatting/gaussians"
SETTINGS = ["--kernels", "reference", *(word for item in SMALL[METHOD] for word in ("--set", item))]


def fit_words(scene: Path, out: Path, seed: int = 0, budget: str = "40steps") -> list[str]:
    return ["fit", METHOD, str(scene), "--out", str(out), "--budget", budget, "--seed", str(seed), *SETTINGS]


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = str(tmp_path_factory.mktemp("runs") / "a")
    return fit_run(
        FitRequest(
            method=METHOD, scene=str(toy_folder), out=out, budget="2steps", overrides=tuple(SMALL[METHOD]), kernels="reference"
        )
    )


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith("lock"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("later", [0.0, 0.3])
def test_of_two_different_fits_one_is_refused(toy_folder: Path, tmp_path: Path, later: float) -> None:
    """Both ended well before, and the second had erased the first."""
    out = tmp_path / "run"
    fits = {}
    for seed in (1, 2):
        fits[seed] = Running(fit_words(toy_folder, out, seed), tmp_path / f"log{seed}")
        time.sleep(later)
    status = {seed: fit.wait() for seed, fit in fits.items()}
    assert sorted(status.values()) == [main.DONE, main.BAD_INPUT], "\n".join(fit.said() for fit in fits.values())
    (first,), (second,) = ([seed for seed in fits if status[seed] == wanted] for wanted in (main.DONE, main.BAD_INPUT))
    holder = rf"{re.escape(str(out))} is being written by process {fits[first].pid} on \S+, since [\d-]+ [\d:]+ UTC\."
    assert re.search(holder, fits[second].said()), fits[second].said()
    assert json.loads((out / "provenance.json").read_text())["seed"] == first
    assert json.loads((out / "scores.json").read_text())["seed"] == first
    assert not (out / locks.INSIDE).exists()


def test_a_refused_fit_leaves_the_folder_that_another_has_just_locked(tmp_path: Path) -> None:
    """The refused one of two that began at the same moment removed the other's folder, which held nothing but a lock yet."""
    out = tmp_path / "run"
    out.mkdir()
    with ExitStack() as stack:
        other = Holder(out, tmp_path, out / locks.INSIDE)
        stack.callback(other.end)
        remove_empty(out)
        assert (out / locks.INSIDE).is_file()
    remove_empty(out)
    assert not out.exists()


def test_the_lock_of_a_folder_that_was_made_again_stays(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    with ExitStack() as stack:
        with locks.locked(out, out / locks.INSIDE):
            shutil.rmtree(out)
            out.mkdir()
            other = Holder(out, tmp_path, out / locks.INSIDE)
            stack.callback(other.end)
        assert (out / locks.INSIDE).is_file()


def test_a_holder_that_has_not_signed_yet_is_waited_for(tmp_path: Path) -> None:
    """Between its lock and its signature the message named nobody."""
    file = tmp_path / ".lock"
    with file.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        signature = threading.Timer(0.2, file.write_text, [f"{os.getpid()}\nhere\n2026-01-01 00:00:00 UTC"])
        signature.start()
        with pytest.raises(InputError, match=f"process {os.getpid()} on here"), locks.locked(tmp_path, file):
            pass
        signature.join()


def test_a_killed_process_holds_nothing(toy_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    fit = Running(fit_words(toy_folder, out, budget="1000000steps"), tmp_path / "log")
    while not (out / "history.jsonl").is_file() and fit.alive():
        time.sleep(0.01)
    with pytest.raises(InputError, match=f"process {fit.pid} on"), RunFolder(out).held():
        pass
    fit.send(signal.SIGKILL)
    fit.wait()
    with RunFolder(out).held():
        assert str(os.getpid()) in (out / locks.INSIDE).read_text()


def test_what_a_killed_process_was_writing_is_removed(tmp_path: Path) -> None:
    """A checkpoint of gigabytes, for instance."""
    left = [tmp_path / name for name in ("checkpoint.safetensors.tmp", ".tmpAb3xYz", "test/0000.png.tmp")]
    kept = [tmp_path / name for name in ("checkpoint.safetensors", "test/0000.png", "notes.tmp", "folder.of.tmp")]
    (tmp_path / "test").mkdir()
    (tmp_path / "folder.of.tmp").mkdir()
    for path in (*left, *kept[:-1]):
        path.touch()
    with RunFolder(tmp_path).held():
        assert not any(path.exists() for path in left) and all(path.exists() for path in kept)


STUDY = """
question = "Why?"
scenes = ["{scene}"]
methods = ["{method}"]
budget = "2steps"
factors = {{ "data.train_views" = [4, 8] }}
"""


def command_words(command: str, run: Path, scene: Path, folder: Path, out: Path) -> list[str]:
    """The words of each command that writes to an --out."""
    (folder / "study.toml").write_text(STUDY.format(scene=scene, method=METHOD))
    (folder / "photos").mkdir()
    Image.new("RGB", (64, 64)).save(folder / "photos" / "0.png")
    return {
        "fit": fit_words(scene, out),
        "compare": ["compare", str(scene), "--methods", METHOD, "--budget", "2steps", "--out", str(out)],
        "ablate": ["ablate", str(folder / "study.toml"), "--out", str(out)],
        "import-photos": ["import-photos", str(folder / "photos"), "--out", str(out)],
        "report": ["report", str(run), "--out", str(out)],
        "export": ["export", str(run), "--to", "ply", "--out", str(out)],
        "render": ["render", str(run), "--frames", "2", "--out", str(out)],
        "explain": ["explain", str(run), "--view", "0", "--pixel", "3,3", "--out", str(out)],
        "rescore": ["rescore", str(run), "--out", str(out)],
        "locate": ["locate", str(run), str(next(scene.glob("test/*.png"))), "--out", str(out)],
    }[command]


INSIDE = {"fit": locks.INSIDE, "compare": locks.INSIDE, "ablate": locks.INSIDE, "report": LOCK}
INSIDE |= {"explain": locks.INSIDE, "rescore": locks.INSIDE}
SUFFIX = {"export": ".ply", "render": ".mp4", "locate": ".json"}
COMMANDS = [*INSIDE, "import-photos", *SUFFIX]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_writes_is_refused(run: Path, toy_folder: Path, tmp_path: Path, command: str) -> None:
    out = tmp_path / f"out{SUFFIX.get(command, '')}"
    words = command_words(command, run, toy_folder, tmp_path, out)
    inside = INSIDE.get(command)
    if inside:
        out.mkdir()
        if command == "rescore":  # one folder for each set of pictures
            out = out / run.name
            out.mkdir()
    before = contents(tmp_path)
    with locks.locked(out, out / inside if inside else None):
        process = Running(words, tmp_path / "log")
        status = process.wait()
    assert f"is being written by process {os.getpid()} on" in process.said(), process.said()
    assert status == main.BAD_INPUT
    (tmp_path / "log").unlink()
    assert contents(tmp_path) == before


def test_a_copy_of_a_scene_is_refused_too(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / cache.TRUTH).write_text(json.dumps({"schema": cache.SCHEMA, "key": "k", "files": {}}))
    with ExitStack() as stack:
        other = Holder(tmp_path / "copy", tmp_path)
        stack.callback(other.end)
        with pytest.raises(InputError, match=f"process {other.process.pid} on"):
            cache.copy(source, tmp_path / "copy")
    assert cache.copy(source, tmp_path / "copy") == tmp_path / "copy"
    assert sorted(path.name for path in tmp_path.glob(".*")) == []


class Holder:
    """Another process that holds the lock beside a path, or the one in ``file``."""

    def __init__(self, what: Path, folder: Path, file: Path | None = None) -> None:
        environment = {"HELD": str(what), "READY": str(folder / "ready")} | ({"LOCK": str(file)} if file else {})
        self.process = Running(["--version"], folder / "log", f"{__name__}:hold", environment)
        while not (folder / "ready").exists() and self.process.alive():
            time.sleep(0.01)

    def end(self) -> None:
        self.process.send(signal.SIGKILL)
        self.process.wait()


def hold() -> None:
    """Hold a lock until killed."""
    file = os.environ.get("LOCK")
    with locks.locked(Path(os.environ["HELD"]), Path(file) if file else None):
        Path(os.environ["READY"]).touch()
        time.sleep(600)


def test_files_of_others_are_not_cleared(toy_folder: Path, tmp_path: Path) -> None:
    """A scene has a folder `test`, as a run has: its pictures were erased."""
    scene = tmp_path / "scene"
    shutil.copytree(toy_folder, scene)
    with pytest.raises(InputError, match="which no run here has written"):
        fit_run(
            FitRequest(
                method=METHOD,
                scene=str(toy_folder),
                out=str(scene),
                budget="2steps",
                overrides=tuple(SMALL[METHOD]),
                kernels="reference",
            )
        )
    assert contents(scene) == contents(toy_folder)


@pytest.mark.parametrize(("option", "value"), [("--budget", "3steps"), ("--set", "field.count=140"), ("--test-views", "2")])
def test_a_comparison_does_not_replace_another(
    run: Path, toy_folder: Path, tmp_path: Path, capsys, option: str, value: str
) -> None:
    place = tmp_path / "out" / "runs" / "splatting-gaussians" / "seed-0"
    shutil.copytree(run, place)
    before = contents(tmp_path)
    words = ["compare", str(toy_folder), "--methods", METHOD, *SETTINGS, "--budget", "2steps", "--out", str(tmp_path / "out")]
    assert main.run([*words, option, value]) == main.BAD_INPUT
    assert "holds another run: its " in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_an_unfinished_import_of_other_photographs_is_kept(tmp_path: Path) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        Image.new("RGB", (64, 64)).save(tmp_path / name / "0.png")
    work = tmp_path / "out" / WORK
    work.mkdir(parents=True)
    job = PhotoJob(str(tmp_path / "one"))
    (work / JOB).write_text(json.dumps({"key": job.key(), "matches": job.matches_key(), "job": json.loads(job.text())}))
    (work / "database.db").write_bytes(b"hours of work")
    with pytest.raises(InputError, match="holds the unfinished import of"):
        reconstruct(PhotoJob(str(tmp_path / "other")), tmp_path / "out")
    assert (work / "database.db").read_bytes() == b"hours of work"


def test_other_truth_for_the_same_pixels_has_a_folder_of_its_own(tmp_path: Path) -> None:
    scene = toy_scene(views=2, size=16)
    first, *more = scene.test
    masked = replace(first, mask=torch.zeros(first.image.shape[:2], dtype=torch.bool))
    others = [
        replace(scene, world_from_local=torch.diag(torch.tensor([1000.0, 1000, 1000, 1]))),
        replace(scene, background=1 - scene.background),
        replace(scene, test=(masked, *more)),
    ]
    folders = [save_truth(each, tmp_path) for each in (scene, *others)]
    assert len(set(folders)) == 4
    assert save_truth(replace(scene, train=scene.train[:1]), tmp_path) == folders[0]


@pytest.mark.parametrize("writer", [(Image.Image, "save"), (np, "savez_compressed")], ids=["picture", "arrays"])
def test_no_half_written_truth_is_taken_for_whole(tmp_path: Path, monkeypatch, writer: tuple[object, str]) -> None:
    """What is there is not written again, so that it must be whole."""
    plain: Callable[..., None] = getattr(*writer)

    def interrupted(*arguments, **options) -> None:
        plain(*arguments, **options)
        raise KeyboardInterrupt

    scene = toy_scene(views=2, size=16)
    with monkeypatch.context() as patch:
        patch.setattr(*writer, interrupted)
        with pytest.raises(KeyboardInterrupt):
            save_truth(scene, tmp_path)
    (folder,) = tmp_path.iterdir()
    suffix = {"save": ".png", "savez_compressed": ".npz"}[writer[1]]
    assert not list(folder.glob(f"*{suffix}"))
    save_truth(scene, tmp_path)
    assert len(list(folder.glob(f"*{suffix}"))) == len(scene.test)
