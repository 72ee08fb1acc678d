"""Whole studies on both executors: the same bits, killed in the middle, nodes lost."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from training_fixtures import SMALL, write_blender

from invgraphics.experiments.executors.local import THREAD_VARIABLES
from invgraphics.experiments.request import AblateRequest
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.studies.ablate import ablate
from invgraphics.testing import toy_scene

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

PROGRAM = (
    "import json, sys\n"
    "from invgraphics.studies.ablate import ablate\n"
    "from invgraphics.experiments.request import AblateRequest\n"
    "ablate(AblateRequest(**json.loads(sys.argv[1])), lambda forecast: None)\n"
)
ISSUE = {"scenes": 2, "methods": tuple(SMALL), "seeds": 3, "size": 64, "steps": 200}
SMALLER = {"scenes": 1, "methods": ("splatting/gaussians",), "seeds": 2, "size": 24, "steps": 50}


def write_study(folder: Path, scenes: int, methods: tuple[str, ...], seeds: int, size: int, steps: int) -> Path:
    """A study of two levels on toy scenes of different sizes of their views' circle."""
    paths = [write_blender(toy_scene(views=8 + 2 * i, size=size), folder / f"toy{i}") for i in range(scenes)]
    base = [f'"{method}:{key}" = {value}' for method in methods for key, _, value in (i.partition("=") for i in SMALL[method])]
    lines = ['question = "Do fewer views cost quality?"', f"scenes = {[str(path) for path in paths]}"]
    lines += [f"methods = {list(methods)}", f"seeds = {list(range(seeds))}", f'budget = "{steps}steps"']
    lines += ["[factors]", '"data.train_views" = [4, 8]', "[base]", *base]
    (folder / "trial.toml").write_text("\n".join(lines))
    return folder / "trial.toml"


def spawn(**request) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", PROGRAM, json.dumps(request)])


def wait_until(condition, seconds: float = 900) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.2)
    assert condition()


def cells(out: Path) -> list[dict]:
    return json.loads((out / "study.json").read_text())["cells"]


def starts(out: Path) -> dict[str, int]:
    """How often each fit was begun or gone on with, from its log."""
    return {log.stem: log.read_text().count("test views in at most about") for log in (out / "jobs").glob("*.log")}


def kill_tree(root: int) -> None:
    """SIGKILL a process and all below it, as when a machine loses power; a raylet's workers would outlive it by seconds."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    doomed = {root}
    while below := {process for process, parent in parents.items() if parent in doomed} - doomed:
        doomed |= below
    for process in doomed:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


@pytest.fixture
def one_thread(monkeypatch) -> None:
    """The same pinned threads whoever fits."""
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("shape", [SMALLER, ISSUE], ids=["smaller", "issue"])
def test_killed_and_resumed_it_has_the_bits_of_the_other_executor(shape: dict, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    study = write_study(tmp_path, **shape)
    local, other = tmp_path / "local", tmp_path / "ray"
    runs = shape["scenes"] * len(shape["methods"]) * 2 * shape["seeds"]

    driver = spawn(study=str(study), out=str(local), checkpoint_every="10steps")
    wait_until(lambda: len(list(local.glob("runs/*/scores.json"))) >= runs // 2)
    driver.kill()
    driver.wait()
    finished = {path: path.stat().st_mtime_ns for path in local.glob("runs/*/scores.json")}
    assert runs // 2 <= len(finished) < runs
    assert {cell["status"] for cell in cells(local)} == {"done", "missing"}
    assert spawn(study=str(study), out=str(local)).wait() == 0
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in finished.items())
    # A fit that the kill interrupted is begun twice, and no other.
    assert sum(starts(local).values()) <= runs + 1
    assert [starts(local)[path.parent.name] for path in finished] == [1] * len(finished)

    assert spawn(study=str(study), out=str(other), executor="ray").wait() == 0
    for out in (local, other):
        assert len(cells(out)) == runs and all(cell["status"] == "done" for cell in cells(out))
    for cell in cells(local):
        assert (local / cell["run"] / CHECKPOINT).read_bytes() == (other / cell["run"] / CHECKPOINT).read_bytes(), cell["id"]


@pytest.mark.usefixtures("one_thread")
def test_a_lost_node_costs_nothing_but_time(tmp_path: Path, monkeypatch) -> None:
    """Two real nodes, one of which dies without a word while both are fitting."""
    steps_in_all = 1500
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    study = write_study(tmp_path, **SMALLER | {"steps": steps_in_all})
    out = tmp_path / "out"
    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    lost = cluster.add_node(**node)
    cluster.wait_for_nodes()
    untouched: dict[Path, int] = {}

    def under_way() -> bool:
        return len([path for path in out.glob("runs/*/fit.json") if not (path.parent / "scores.json").exists()]) == 2

    def kill() -> None:
        wait_until(under_way)
        untouched.update({path: path.stat().st_mtime_ns for path in out.glob("runs/*/scores.json")})
        kill_tree(lost.all_processes["raylet"][0].process.pid)
        cluster.remove_node(lost, allow_graceful=False)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        request = AblateRequest(
            study=str(study), out=str(out), executor="ray", address=cluster.address, checkpoint_every="50steps"
        )
        _, failed = ablate(request, lambda forecast: None)
    finally:
        thread.join()
        cluster.shutdown()
    assert not failed and all(cell["status"] == "done" for cell in cells(out)) and len(cells(out)) == 4
    assert sorted(starts(out).values()) == [1, 1, 1, 2]
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in untouched.items())
    twice = next(name for name, count in starts(out).items() if count == 2)
    # The second time it began where its checkpoint was.
    again = (out / "jobs" / f"{twice}.log").read_text().rpartition("test views in at most about")[2]
    found = re.search(r"step (\d+)", again)
    assert found is not None and int(found.group(1)) > 50
    steps = [json.loads(line)["step"] for line in (out / "runs" / twice / "history.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps)) and steps[-1] == steps_in_all
