"""What runs fits: processes of their own, which neither outlive their parent nor lose what they did."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from training_fixtures import SMALL

from invgraphics import plugins
from invgraphics.errors import InputError
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.executors.local import LocalExecutor
from invgraphics.experiments.request import FitRequest
from invgraphics.interruption import Terminated
from invgraphics.runs.folder import CHECKPOINT, RunFolder
from invgraphics.thread_pools import usable_cores

METHOD = "splatting/gaussians"
ENDLESS = {"budget": "1000000steps", "checkpoint_every": "10000s"}
"""A fit whose only checkpoint is the one that it writes when it is stopped."""


@pytest.fixture
def request_for(toy_folder: Path, tmp_path: Path):
    def make(name: str, **more) -> FitRequest:
        out, truth = str(tmp_path / "runs" / name), str(tmp_path / "truth")
        base = {"method": METHOD, "scene": str(toy_folder), "overrides": tuple(SMALL[METHOD]), "kernels": "reference"}
        return FitRequest(**base | {"out": out, "truth": truth, "budget": "3steps", "existing": "reuse"} | more)

    return make


def wait_for(path: Path, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert path.exists(), f"{path} never appeared"


def test_good_and_bad_fits_are_told_apart(request_for, tmp_path: Path) -> None:
    good, bad = request_for("good"), request_for("bad", scene=str(tmp_path / "nowhere"))
    executor = LocalExecutor(Resources(threads=1, logs=True))
    outcomes = {Path(o.request.out).name: o for o in executor.run([bad, good], tmp_path / "jobs")}
    assert outcomes["good"] == Outcome(good, 0, "", outcomes["good"].seconds)
    assert outcomes["good"].seconds > 0
    assert outcomes["bad"].status == 1 and "nowhere' is neither" in outcomes["bad"].error
    assert (tmp_path / "runs" / "good" / "scores.json").is_file()
    assert json.loads((tmp_path / "runs" / "good" / "environment.json").read_text())["threads"] == 1
    assert "fit 3 steps" in (tmp_path / "jobs" / "good.log").read_text()


def test_a_death_without_a_word_is_reported(request_for, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    (outcome,) = LocalExecutor().run([request_for("a")], tmp_path / "jobs")
    assert outcome.status == 1 and "left no message" in outcome.error


def test_threads_are_pinned(request_for, tmp_path: Path, monkeypatch) -> None:
    """The child's environment, seen by a program that does nothing but write it down."""
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\nenv > {tmp_path}/$OMP_NUM_THREADS.env\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    list(LocalExecutor(Resources(threads=7)).run([request_for("a")], tmp_path / "jobs"))
    lines = (tmp_path / "7.env").read_text().splitlines()
    assert {"OMP_NUM_THREADS=7", "MKL_NUM_THREADS=7", "NUMBA_NUM_THREADS=7"} <= set(lines)


def test_at_most_so_many_run_at_a_time(request_for, tmp_path: Path, monkeypatch) -> None:
    program = tmp_path / "python"
    log = tmp_path / "log"
    program.write_text(f"#!/bin/sh\necho begin >> {log}\nsleep 0.2\necho end >> {log}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr("invgraphics.experiments.executors.local.usable_cores", lambda: 2)
    requests = [request_for(str(i)) for i in range(5)]
    for jobs in (1, 2):
        log.unlink(missing_ok=True)
        done = [Path(o.request.out).name for o in LocalExecutor(Resources(jobs=jobs)).run(requests, tmp_path / "jobs")]
        assert sorted(done) == ["0", "1", "2", "3", "4"]
        running = most = 0
        for line in log.read_text().split():
            running += 1 if line == "begin" else -1
            most = max(most, running)
        assert most == jobs


def test_more_jobs_than_cores_are_refused() -> None:
    with pytest.raises(InputError, match=f"has {usable_cores()} cores"):
        LocalExecutor(Resources(jobs=usable_cores() + 1))


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as at a terminal: jobs that a script puts into the background inherit that it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_stops_the_fit_with_a_checkpoint(request_for, tmp_path: Path) -> None:
    """The signal comes while the executor waits, and to this process alone, as from `kill -INT`."""
    run = tmp_path / "runs" / "long"
    outcomes = LocalExecutor(Resources(threads=1)).run([request_for("long", **ENDLESS)], tmp_path / "jobs")

    def interrupt() -> None:
        wait_for(run / "history.jsonl")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        next(outcomes)
    assert (run / CHECKPOINT).is_file()
    assert not (run / "scores.json").exists()


SLOW = """#!{python}
import pathlib, signal, sys, time
signal.signal(signal.SIGINT, lambda *_: (time.sleep(2.5), pathlib.Path("{folder}/checkpoint").touch(), sys.exit(130)))
signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
pathlib.Path("{folder}/began").touch()
time.sleep(60)
"""


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("terminated", [False, True])
def test_an_interrupted_fit_has_time_for_a_long_step(request_for, tmp_path: Path, monkeypatch, terminated: bool) -> None:
    """Longer than a terminated one, which ends within two seconds."""
    program = tmp_path / "python"
    program.write_text(SLOW.format(python=sys.executable, folder=tmp_path))
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(Terminated, "raised", terminated)
    outcomes = LocalExecutor().run([request_for("slow")], tmp_path / "jobs")

    def interrupt() -> None:
        wait_for(tmp_path / "began")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        next(outcomes)
    assert (tmp_path / "checkpoint").exists() != terminated


def test_a_fit_does_not_outlive_its_parent(request_for, tmp_path: Path) -> None:
    """Kill -9 leaves the parent no time to tidy up; the child must notice by itself, and leave a checkpoint."""
    program = (
        "import json, sys; from pathlib import Path\n"
        "from invgraphics.experiments.executors.local import LocalExecutor\n"
        "from invgraphics.experiments.request import FitRequest\n"
        "list(LocalExecutor().run([FitRequest.from_json(json.loads(sys.argv[1]))], Path(sys.argv[2])))\n"
    )
    request = json.dumps(request_for("long", **ENDLESS).to_json())
    parent = subprocess.Popen([sys.executable, "-c", program, request, str(tmp_path / "jobs")])
    run = tmp_path / "runs" / "long"
    wait_for(run / "history.jsonl")
    parent.kill()
    parent.wait()
    wait_for(run / CHECKPOINT, seconds=60)
    with RunFolder(run).held(wait=True):  # comes only once the child is gone
        assert not (run / "scores.json").exists()


def test_executors_are_a_registry() -> None:
    assert set(plugins.names("executors")) == {"local", "ray"}
    assert plugins.load("executors", "local") is LocalExecutor


def test_without_ray_a_sentence(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"needs the package ray"):
        plugins.load("executors", "ray")(Resources())


class StubRay(ModuleType):
    """What `RayExecutor` uses of ray, in this process: tasks run when they are got, and again after a named exception."""

    class exceptions:  # noqa: N801  # as in ray
        class RayError(Exception):
            pass

    def __init__(self) -> None:
        super().__init__("ray")
        self.connected: list[tuple[str, dict]] = []
        self.asked: dict = {}

    def init(self, address: str, **options) -> None:
        self.connected.append((address, options))

    def shutdown(self) -> None:
        self.connected.pop()

    def nodes(self) -> list[dict]:
        return [{"Alive": True, "Resources": {"CPU": 2.0}}, {"Alive": False, "Resources": {"CPU": 64.0}}]

    def remote(self, function):
        def options(**asked):
            self.asked = asked
            return SimpleNamespace(remote=lambda *arguments: Task(function, arguments, asked))

        return SimpleNamespace(options=options)

    def wait(self, tasks: list, num_returns: int) -> tuple[list, list]:
        return tasks[-num_returns:], tasks[:-num_returns]

    def get(self, task):
        return task.result()


class Task:
    def __init__(self, function, arguments: tuple, asked: dict) -> None:
        self.function, self.arguments, self.asked = function, arguments, asked

    def result(self):
        if "lost" in self.arguments[0].out:
            raise StubRay.exceptions.RayError("first\nthe node died")
        for _ in range(self.asked["max_retries"]):
            with contextlib.suppress(*self.asked["retry_exceptions"]):
                return self.function(*self.arguments)
        return self.function(*self.arguments)


def test_ray_runs_fits_and_begins_again_those_that_were_stopped(request_for, tmp_path: Path, monkeypatch) -> None:
    """Two that end well or badly, one whose node shut down once, and one whose nodes die."""
    program = tmp_path / "python"
    program.write_text(
        f"#!/bin/sh\necho $OMP_NUM_THREADS >> {tmp_path}/log\n"
        f'case "$*" in *bad*) exit 3;; *stopped*) [ -e {tmp_path}/once ] || {{ touch {tmp_path}/once; exit 130; }};; esac\n'
    )
    program.chmod(0o755)
    ray = StubRay()
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setitem(sys.modules, "ray", ray)
    requests = [request_for(name) for name in ("good", "bad", "stopped", "lost")]
    executor = plugins.load("executors", "ray")(Resources(threads=2))
    outcomes = {Path(one.request.out).name: one for one in executor.run(requests, tmp_path / "jobs")}
    assert {name: one.status for name, one in outcomes.items()} == {"good": 0, "bad": 3, "stopped": 0, "lost": 1}
    assert "left no message" in outcomes["bad"].error and outcomes["good"].error == ""
    assert outcomes["lost"].error == "The worker was lost 4 times: the node died"
    assert (tmp_path / "log").read_text().split() == ["2"] * 4
    assert ray.asked["num_cpus"] == 2 and ray.connected == []
    with pytest.raises(InputError, match="requests 3 cores, and the cluster's largest node has 2"):
        next(plugins.load("executors", "ray")(Resources(threads=3)).run(requests, tmp_path / "jobs"))
    assert ray.connected == []
