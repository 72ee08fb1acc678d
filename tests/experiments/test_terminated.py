"""SIGTERM ends a fit within two seconds wherever it is, with one sentence and its last whole checkpoint.

Each phase is entered for real and then held up by something that no signal handler of Python's gets through: a call into C of
a minute. On a loaded machine the two seconds are multiplied by how much slower a busy loop runs.
"""

import hashlib
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import Running, slowness
from training_fixtures import SMALL

from invgraphics.interruption import INTERRUPTED
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT

METHOD = "splatting/gaussians"
SECONDS = 2.0
REACHED = "REACHED"


def stuck(*_: Any, **__: Any) -> None:
    """A minute in C, without the interpreter's lock, which ignores signals."""
    Path(os.environ[REACHED]).touch()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 200_000_000)


def after(count: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, stuck from its call number ``count`` on."""
    calls = iter(range(count))

    def call(*args: Any, **more: Any) -> Any:
        if next(calls, None) is None:
            stuck()
        return function(*args, **more)

    return call


def opening() -> None:
    """Stuck while a data set is loaded."""
    from invgraphics.experiments import run

    run.open_with_progress = stuck  # type: ignore[assignment]


def compiling() -> None:
    """Stuck in the warm-up, where kernels are compiled."""
    from invgraphics.training.fit import Fit

    Fit.warmup_step = stuck  # type: ignore[method-assign]


def first_step() -> None:
    """Stuck in the first step."""
    from invgraphics.training.fit import Fit

    Fit.step = after(1, Fit.step)  # type: ignore[method-assign]  # the warm-up takes one too


def later_step() -> None:
    """Stuck in a later step, when there is a checkpoint."""
    from invgraphics.training.fit import Fit

    Fit.step = after(9, Fit.step)  # type: ignore[method-assign]


def saving() -> None:
    """Stuck in the middle of writing the third checkpoint."""
    plain = checkpoint.save_file
    calls = iter(range(2))

    def save(flat: Any, path: Path) -> None:
        if next(calls, None) is None:
            path.write_bytes(b"the beginning")
            stuck()
        plain(flat, path)

    checkpoint.save_file = save  # type: ignore[assignment]


def evaluating() -> None:
    """Stuck in the rendering of the second test view."""
    from invgraphics.experiments import evaluate

    evaluate._picture = after(1, evaluate._picture)


def swallowing() -> None:
    """A library that catches all exceptions, and then takes its time."""
    from invgraphics.experiments import run

    def careless(*_: Any) -> None:
        Path(os.environ[REACHED]).touch()
        try:
            time.sleep(60)
        except BaseException:
            time.sleep(60)

    run.open_with_progress = careless  # type: ignore[assignment]


def turning() -> None:
    """A library whose import turns all exceptions into its own, as that of torch does."""
    from invgraphics.experiments import run

    def careless(*_: Any) -> None:
        Path(os.environ[REACHED]).touch()
        try:
            time.sleep(60)
        except BaseException:
            raise RuntimeError from None

    run.open_with_progress = careless  # type: ignore[assignment]


def loading() -> None:
    """An extension module that does not survive an exception in its initialisation."""
    from invgraphics.experiments import run

    folder = Path(os.environ[REACHED]).parent
    (folder / "fragile.py").write_text("import os, time\ntry:\n    time.sleep(60)\nexcept BaseException:\n    os.abort()\n")

    def load(*_: Any) -> None:
        sys.path.insert(0, str(folder))
        Path(os.environ[REACHED]).touch()
        importlib.import_module("fragile")

    run.open_with_progress = load  # type: ignore[assignment]


def _start(toy_folder: Path, tmp_path: Path, phase: str) -> Running:
    words = ["fit", METHOD, str(toy_folder), "--out", str(tmp_path / "run"), "--budget", "12steps", "--kernels", "reference"]
    words += ["--checkpoint-every", "1steps", *(word for item in SMALL[METHOD] for word in ("--set", item))]
    process = Running(words, tmp_path / "log", f"{__name__}:{phase}", {REACHED: str(tmp_path / "reached")})
    wait_for(tmp_path / "reached", process)
    return process


def wait_for(path: Path, process: Running, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end and process.alive():
        time.sleep(0.01)
    assert path.exists(), process.said()


def _terminate(process: Running) -> int:
    """Exit status after SIGTERM, which came in time."""
    time.sleep(0.1)
    slow = slowness()
    began = time.monotonic()
    process.send(signal.SIGTERM)
    status = process.wait()
    took = time.monotonic() - began
    assert took < SECONDS * slow, f"{took:.2f} s on a machine that is {slow:.1f} times slower than an idle one"
    return status


STEPS = {opening: None, compiling: None, first_step: None, later_step: 8, saving: 2, evaluating: 12, swallowing: None}
"""Phase -> steps of the checkpoint that the fit has then."""


@pytest.mark.parametrize("phase", [phase.__name__ for phase in STEPS])
def test_sigterm_ends_a_fit_in_two_seconds(toy_folder: Path, tmp_path: Path, phase: str) -> None:
    process = _start(toy_folder, tmp_path, phase)
    assert _terminate(process) == INTERRUPTED
    assert process.said().splitlines()[-1].startswith("Terminated; ")
    steps = {function.__name__: steps for function, steps in STEPS.items()}[phase]
    saved = tmp_path / "run" / CHECKPOINT
    assert saved.is_file() == (steps is not None)
    if steps is not None:
        assert int(checkpoint.load(saved)["fit"]["steps"]) == steps
    assert not (tmp_path / "run" / "scores.json").exists()


def test_sigterm_is_an_interruption_whatever_a_library_makes_of_it(toy_folder: Path, tmp_path: Path) -> None:
    process = _start(toy_folder, tmp_path, "turning")
    assert _terminate(process) == INTERRUPTED
    assert process.said().splitlines()[-1] == "Interrupted."


def test_sigterm_is_not_raised_in_the_initialisation_of_a_module(toy_folder: Path, tmp_path: Path) -> None:
    process = _start(toy_folder, tmp_path, "loading")
    assert _terminate(process) == INTERRUPTED
    assert process.said().splitlines()[-1] == "Terminated."


@pytest.mark.parametrize("seconds", [0.1, 0.5, 1.5])
def test_sigterm_ends_the_imports(toy_folder: Path, tmp_path: Path, seconds: float) -> None:
    """Before there is anything to be said, the system's own end of a process is as good."""
    command = [sys.executable, "-m", "invgraphics", "fit", METHOD, str(toy_folder), "--out", str(tmp_path / "run")]
    process = subprocess.Popen([*command, "--budget", "1000000steps"], stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    slow = slowness()
    began = time.monotonic()
    process.terminate()
    _, said = process.communicate(timeout=60)
    assert time.monotonic() - began < SECONDS * slow
    assert process.returncode in (-signal.SIGTERM, INTERRUPTED)
    assert "Traceback" not in said and len(said.splitlines()) <= 2


SCENE = """
name = "tiny"
builder = "materials"
summary = "Small."
stresses = "Nothing."
lo = [-1.05, -1.05, -0.8]
hi = [1.05, 1.05, 0.7]
depth = 3
size = [20, 16]
rig = { kind = "hemisphere", radius = 3.5, fov = 38.0 }
views = { train = 2, val = 1, test = 1 }
samples = { train = 1000000, val = 1, test = 4 }
"""
"""A scene whose first view takes hours."""


def test_sigterm_ends_the_rendering_of_the_truth(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    cache = tmp_path / "cache"
    words = ["fit", METHOD, str(tmp_path / "scene.toml"), "--out", str(tmp_path / "run"), "--budget", "2steps"]
    process = Running(words, tmp_path / "log", environment={"INVGRAPHICS_CACHE": str(cache)})
    end = time.monotonic() + 60
    while not list(cache.glob("scenes/*.partial")) and time.monotonic() < end:
        time.sleep(0.05)
    (partial,) = cache.glob("scenes/*.partial")
    time.sleep(1)
    assert _terminate(process) == INTERRUPTED
    assert _processes_with(str(partial)) == []


def test_a_renderer_does_not_outlive_a_killed_command(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    cache = tmp_path / "cache"
    process = Running(
        ["make-scene", str(tmp_path / "scene.toml")], tmp_path / "log", environment={"INVGRAPHICS_CACHE": str(cache)}
    )
    end = time.monotonic() + 60
    while not list(cache.glob("scenes/*.partial")) and time.monotonic() < end:
        time.sleep(0.05)
    (partial,) = cache.glob("scenes/*.partial")
    time.sleep(1)
    process.send(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    end = time.monotonic() + 10
    while _processes_with(str(partial)) and time.monotonic() < end:
        time.sleep(0.05)
    assert _processes_with(str(partial)) == []


def _processes_with(argument: str) -> list[int]:
    """Processes that have ``argument`` on their command lines."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if argument.encode() in place.read_bytes().split(b"\0"):
                found.append(int(place.parent.name))
        except OSError:
            continue
    return found
