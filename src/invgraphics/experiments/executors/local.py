"""Local executor: each fit in its own spawned process, so that time and memory are measured per fit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from invgraphics import plugins
from invgraphics.errors import InputError
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.request import FitRequest
from invgraphics.interruption import INTERRUPTED, WITH_PARENT, Terminated
from invgraphics.runs.schema import write_json
from invgraphics.tables import read_json
from invgraphics.thread_pools import usable_cores

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Environment variables from which libraries take their number of threads."""
INTERRUPT_SECONDS = 30.0
"""Seconds in which an interrupted fit ends its step, or what is being compiled, before it is terminated."""


class FitProcess:
    """Child process of one fit; it ends when the parent does.

    Args:
        request: what to fit.
        jobs: folder for the job file, the error message and the log.
        resources: threads, and whether there is a log.
    """

    def __init__(self, request: FitRequest, jobs: Path, resources: Resources) -> None:
        jobs.mkdir(parents=True, exist_ok=True)
        job = jobs / f"{_name(request)}.json"
        self._request, self._began = request, time.monotonic()
        self._report = job.with_suffix(".error.json")
        self._report.unlink(missing_ok=True)
        write_json(job, request.to_json())
        self._log = job.with_suffix(".log").open("a") if resources.logs else None
        pinned = {} if resources.threads is None else dict.fromkeys(THREAD_VARIABLES, str(resources.threads))
        # A process that dies closes its pipes, however it dies: the open standard input is what keeps the child alive.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "invgraphics.experiments.run", str(job), WITH_PARENT],
            stdin=subprocess.PIPE,
            stdout=self._log,
            stderr=self._log,
            env=os.environ | plugins.environment() | pinned,
        )

    def wait(self) -> Outcome:
        """Wait until the fit's process ends."""
        status = self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        if self._log is not None:
            self._log.close()
        error = "" if status in (0, INTERRUPTED) else self._error(status)
        return Outcome(self._request, status, error, time.monotonic() - self._began)

    def stop(self) -> None:
        """Interrupt the fit, which ends its step and writes a checkpoint; terminate it after `INTERRUPT_SECONDS`.

        After Ctrl-C at a terminal it is interrupted already, and again changes nothing. Where this process was terminated, its
        fits are, too: there is no time for a long step.
        """
        if Terminated.raised:
            self._process.terminate()
            return
        self._process.send_signal(signal.SIGINT)
        last = threading.Timer(INTERRUPT_SECONDS, self._process.terminate)
        last.daemon = True
        last.start()

    def _error(self, status: int) -> str:
        try:
            return str(read_json(self._report)["error"])
        except (InputError, KeyError, TypeError):
            if status == -signal.SIGKILL:
                return "The process was killed and left no message, as where memory runs out. Try a smaller --size."
            return f"The process ended with status {status} and left no message."


def _name(request: FitRequest) -> str:
    """Name of a run's job: its folder's path below ``runs``."""
    *_, parent, name = Path(request.out).resolve().parts
    return name if parent == "runs" else f"{parent}-{name}"


class LocalExecutor:
    """Runs a fixed number of fits at a time; one by default, so that nothing disturbs their timings."""

    def __init__(self, resources: Resources | None = None) -> None:
        self._resources = resources or Resources()
        if not 1 <= self._resources.jobs <= usable_cores():
            raise InputError(f"--jobs cannot be {self._resources.jobs}: this machine has {usable_cores()} cores.")

    def run(self, requests: Sequence[FitRequest], jobs: Path) -> Generator[Outcome, None, None]:
        """See `Executor.run`."""
        queue = deque(requests)
        running: dict[Future[Outcome], FitProcess] = {}
        with ThreadPoolExecutor(self._resources.jobs) as pool:
            try:
                while queue or running:
                    while queue and len(running) < self._resources.jobs:
                        process = FitProcess(queue.popleft(), jobs, self._resources)
                        running[pool.submit(process.wait)] = process
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        del running[future]
                        yield future.result()
            finally:
                for process in running.values():
                    process.stop()
