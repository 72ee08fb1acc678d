"""Long work in a process of its own: progress comes out of it line by line, and whatever ends it becomes one sentence.

A worker prints ``progress DONE TOTAL WHAT`` or ``error JSON`` (sentence and remedy) on its standard output.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

from invgraphics.errors import InputError

Progress = Callable[[int, int, str], None]


def say_progress(done: int, total: int, what: str) -> None:
    """Called by a worker: how much is done."""
    print(f"progress {done} {total} {what}", flush=True)


def say_error(error: InputError) -> None:
    """Called by a worker that gives up."""
    print(f"error {json.dumps([error.sentence, error.remedy])}", flush=True)


def run_worker(
    module: str, folder: Path, progress: Progress, subject: str, remedy: str, environment: Mapping[str, str] | None = None
) -> None:
    """Run ``python -m module folder`` to its end; an interruption here ends it too.

    Args:
        module: what to run.
        folder: its only argument, in which it finds its request and leaves its result.
        progress: called with (done, total, what is being done).
        subject: beginning of the sentence about a failure: "The scene 'x' could not be rendered".
        remedy: what to do where the process was killed.
        environment: of the process; this one's if not given.

    Raises:
        InputError: the worker gave up, failed or was killed.
    """
    command = [sys.executable, "-P", "-m", module, str(folder)]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints, text=True, env=environment)
        try:
            failure = _follow(process, progress)
            status = process.wait()
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        if status:
            raise failure or _explain(subject, remedy, status, complaints)


def _follow(process: subprocess.Popen[str], progress: Progress) -> InputError | None:
    """Pass progress on until the process closes its output; what it said went wrong, if it did."""
    failure = None
    for line in process.stdout or ():
        word, _, rest = line.rstrip("\n").partition(" ")
        if word == "progress":
            done, total, what = rest.split(" ", 2)
            progress(int(done), int(total), what)
        elif word == "error":
            failure = InputError(*json.loads(rest))
    return failure


def _explain(subject: str, remedy: str, status: int, complaints: IO[str]) -> InputError:
    """Why a process failed that could not say so itself."""
    if status < 0:
        return InputError(f"{subject}: its process died of {signal.Signals(-status).name}.", remedy)
    complaints.seek(0)
    last = next((line.strip() for line in reversed(complaints.read().splitlines()) if line.strip()), f"exit status {status}")
    return InputError(f"{subject}: {last}")
