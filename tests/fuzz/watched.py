"""The reading process from outside: one input at a time, ended when it takes too long, started again when it died."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path

SECONDS = 10.0
"""Longest time for one input."""


class Reader:
    """A process of `reader`, started when it is needed.

    Args:
        kind: what it reads, a key of `reader.READERS`.
        good: a good input, which it reads first and whose digest is `digest`.
    """

    def __init__(self, kind: str, good: Path) -> None:
        self.kind, self.good = kind, good
        self._process: subprocess.Popen[bytes] | None = None
        outcome, self.digest = self.read(good)
        assert outcome == "accepted", self.digest

    def read(self, path: Path) -> tuple[str, str]:
        """The outcome (``accepted``, ``refused``, ``raised``, ``hung``, ``died``) and a digest, a sentence or a traceback."""
        if self._process is None:
            command = [sys.executable, str(Path(__file__).with_name("reader.py"))]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
            )
            self._ask(self.good, 60.0)
        return self._ask(path, SECONDS)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _ask(self, path: Path, seconds: float) -> tuple[str, str]:
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps([self.kind, str(path)]).encode() + b"\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], seconds)[0]:
            self.close()
            return "hung", f"no answer after {seconds:g} s"
        line = process.stdout.readline()
        if not line:
            status = process.wait()
            self.close()
            return "died", f"exit status {status}"
        outcome, what = json.loads(line)
        return outcome, what
