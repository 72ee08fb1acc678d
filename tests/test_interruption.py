"""Signals that come where Python swallows exceptions, and fits that may not even write why they failed."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from invgraphics.errors import InputError
from invgraphics.experiments import run
from invgraphics.interruption import INTERRUPTED, Terminated, terminate

SWALLOWED = """
import os, signal, time, weakref
from invgraphics.interruption import end_on_sigterm

class Node: pass

end_on_sigterm()
node = Node()
watched = weakref.ref(node, lambda _: (os.kill(os.getpid(), signal.SIGTERM), time.sleep(0.001)))
try:
    del node
    time.sleep(30)
except KeyboardInterrupt:
    print("ended")
"""


def test_a_signal_in_a_callback_is_not_lost() -> None:
    done = subprocess.run([sys.executable, "-c", SWALLOWED], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ended\n", "")


def test_other_exceptions_of_callbacks_are_shown() -> None:
    script = SWALLOWED.replace("(os.kill(os.getpid(), signal.SIGTERM), time.sleep(0.001))", "1 / 0").replace("(30)", "(0)")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "ZeroDivisionError" in done.stderr


UNCAUGHT = """
import os, signal, time
from invgraphics.interruption import end_on_sigterm

end_on_sigterm()
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(30)
"""


def test_a_signal_that_comes_before_a_command_begins_is_an_interruption() -> None:
    done = subprocess.run([sys.executable, "-c", UNCAUGHT], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (INTERRUPTED, "Terminated.\n")


def test_other_uncaught_exceptions_are_shown() -> None:
    script = UNCAUGHT.replace("os.kill(os.getpid(), signal.SIGTERM)", "1 / 0")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1 and done.stderr.rstrip().endswith("ZeroDivisionError: division by zero")


def test_a_fit_whose_interruption_a_library_made_its_own_exception_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def careless(*_: object) -> None:
        try:
            terminate(signal.SIGTERM, None)
        except KeyboardInterrupt:
            raise RuntimeError from None

    job = tmp_path / "job.json"
    job.write_text(json.dumps({}))
    monkeypatch.setattr(Terminated, "raised", False)
    monkeypatch.setattr(run.FitRequest, "from_json", careless)
    assert run.work(job) == INTERRUPTED
    assert not job.with_suffix(".error.json").exists()


@pytest.mark.parametrize("error", [InputError("The folder cannot be written."), PermissionError(13, "Permission denied")])
def test_a_fit_that_may_write_nothing_fails_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, error: Exception
) -> None:
    def refuse(*_: object) -> None:
        raise error

    def deny(path: Path, _: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    job = tmp_path / "job.json"
    job.write_text(json.dumps({}))
    monkeypatch.setattr(run.FitRequest, "from_json", refuse)
    monkeypatch.setattr(run, "write_json", deny)
    assert run.work(job) == 1
    assert "Traceback" not in capsys.readouterr().err
