"""Worker processes: progress is reported line by line, and every failure becomes one `InputError`.

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
from subprocess import PIPE
from typing import IO

from invgraphics.errors import InputError
from invgraphics.interruption import WITH_PARENT, end_with_parent
from invgraphics.tables import parse_json

Progress = Callable[[int, int, str], None]


def write_progress(done: int, total: int, what: str) -> None:
    """Write a worker's progress as a line of standard output, with ? for what its encoding does not have."""
    encoding = sys.stdout.encoding or "utf-8"
    line = " ".join(what.split()).encode(encoding, "replace").decode(encoding)
    # A parent that was killed leaves a closed pipe: writing to it ends this process too.
    print(f"progress {done} {total} {line}", flush=True)


def write_error(error: InputError) -> None:
    """Write a worker's failure as a line of standard output."""
    print(f"error {json.dumps([error.sentence, error.remedy])}", flush=True)


def worker_main(main: Callable[[Path], None], unwritable: Callable[[Path, OSError], InputError]) -> None:
    """Run a worker's main function on the folder of the command line; a failure is written, and ends with exit status 1.

    Args:
        main: does the work; reads its request from the folder and leaves its result there.
        unwritable: explains what the operating system refused.
    """
    end_with_parent()
    folder = Path(sys.argv[1])
    try:
        main(folder)
    except (InputError, OSError) as error:
        write_error(error if isinstance(error, InputError) else unwritable(folder, error))
        sys.exit(1)


def run_worker(
    module: str,
    folder: Path,
    progress: Progress,
    subject: str,
    remedy: str,
    environment: Mapping[str, str] | None = None,
    lock: int | None = None,
) -> None:
    """Run ``python -m module folder`` to its end, forwarding its progress.

    It ends with this process, and an interruption here ends it too.

    Args:
        module: what to run.
        folder: its only argument, in which it finds its request and leaves its result.
        progress: called with (done, total, what is being done).
        subject: beginning of the sentence about a failure: "The scene 'x' could not be rendered".
        remedy: what to do where the process was killed.
        environment: of the process; this one's if not given.
        lock: descriptor of the lock of ``folder``, which the process keeps until it ends.

    Raises:
        InputError: the worker gave up, failed or was killed.
    """
    command = [sys.executable, "-P", "-m", module, str(folder), WITH_PARENT]
    kept = () if lock is None else (lock,)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        process = subprocess.Popen(
            command, stdin=PIPE, stdout=PIPE, stderr=complaints, text=True, errors="replace", env=environment, pass_fds=kept
        )
        try:
            failure = _follow(process, progress)
            status = process.wait()
        finally:
            process.kill()  # what it has written is whole, and another one goes on with it
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                pipe.close()
        if status:
            raise failure or _explain(subject, remedy, status, complaints)


def _follow(process: subprocess.Popen[str], progress: Progress) -> InputError | None:
    """Forward progress until the process closes its output; returns its reported failure, if any."""
    failure = None
    for line in process.stdout or ():
        word, _, rest = line.rstrip("\n").partition(" ")
        if word == "progress":
            done, total, what = rest.split(" ", 2)
            progress(int(done), int(total), what)
        elif word == "error":
            failure = InputError(*parse_json(rest, "the error of a process"))
    return failure


def _explain(subject: str, remedy: str, status: int, complaints: IO[str]) -> InputError:
    """Make the error of a process that reported none: its signal, or the last line of its standard error."""
    if status < 0:
        return InputError(f"{subject}: its process died of {signal.Signals(-status).name}.", remedy)
    complaints.seek(0)
    last = next((line.strip() for line in reversed(complaints.read().splitlines()) if line.strip()), f"exit status {status}")
    return InputError(f"{subject}: {last}")
