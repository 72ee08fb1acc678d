"""The reading process from outside: one input at a time, ended when it takes too long, started again when it died."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path

SECONDS = 10.0
"""Longest processor time for one input; of a process that sleeps, longest time."""
ASLEEP = 0.02
"""A process that uses less of the time than this waits for something that is not a processor."""
READER = Path(__file__).with_name("reader.py")
STARTING = 120.0
"""Longest time for a process that starts and reads its first input."""


class Process:
    """A process of `reader`, started when it is needed; the libraries that it has loaded serve all inputs.

    Args:
        script: what it runs.
    """

    def __init__(self, script: Path = READER) -> None:
        self.script = script
        self._process: subprocess.Popen[bytes] | None = None
        self._good: tuple[str, Path] | None = None

    def begin(self, kind: str, good: Path) -> tuple[str, str]:
        """Read a good input, from which bounds of memory start; ``kind`` is a key of `reader.READERS`."""
        if self._process is None:
            command = [sys.executable, str(self.script)]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
            )
        answer = self._ask(kind, good, True, STARTING)
        self._good = (kind, good) if answer[0] == "accepted" else None
        return answer

    def read(self, kind: str, path: Path, good: Path) -> tuple[str, str]:
        """Read ``path`` after ``good``, see `Reader.read`."""
        if self._good != (kind, good):
            answer = self.begin(kind, good)
            if answer[0] != "accepted":
                return answer
        return self._ask(kind, path, False, SECONDS)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = self._good = None

    def _ask(self, kind: str, path: Path, good: bool, seconds: float) -> tuple[str, str]:
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        started = time.monotonic()
        process.stdin.write(json.dumps([kind, str(path), good]).encode() + b"\n")
        process.stdin.flush()
        spent = _processor_seconds(process.pid)
        while not select.select([process.stdout], [], [], seconds)[0]:
            used = _processor_seconds(process.pid) - spent
            if used >= seconds or used < ASLEEP * (time.monotonic() - started):
                self.close()
                return "hung", f"no answer after {seconds:g} s"
        line = process.stdout.readline()
        if not line:
            status = process.wait()
            self.close()
            return "died", f"exit status {status}, after {time.monotonic() - started:.1f} s"
        outcome, what = json.loads(line)
        return outcome, what


def _processor_seconds(pid: int) -> float:
    """Processor time of a process, where /proc tells it: a busy machine must not look like a hang; elsewhere all time."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return time.monotonic()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Reader:
    """A `Process` for the damaged copies of one good input, which it reads first and whose digest is `digest`."""

    def __init__(self, process: Process, kind: str, good: Path) -> None:
        self._process, self._kind, self._good = process, kind, good
        outcome, self.digest = process.begin(kind, good)
        assert outcome == "accepted", self.digest

    def read(self, path: Path) -> tuple[str, str]:
        """The outcome and a digest, a sentence or a traceback.

        Outcomes: ``accepted``, ``refused``, ``raised``, ``died``; ``hung`` beyond `SECONDS`, ``greedy`` beyond `reader.MEMORY`.
        """
        return self._process.read(self._kind, path, self._good)
