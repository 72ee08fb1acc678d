"""Commands in processes of their own that need no seconds for imports: they are forked from a server that has done those."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

PRELOADED = [
    *("invgraphics.experiments.compare", "invgraphics.studies.ablate", "invgraphics.report.study", "invgraphics.tools.photos"),
    *("invgraphics.recipes.recipe", "invgraphics.training.fit", "invgraphics.scenes.colmap_library", "numba"),
    *(
        "matplotlib.pyplot",
        "pyarrow.parquet",
        "statsmodels.api",
        "flip_evaluator",
        "pytorch_msssim",
        "scipy.ndimage",
        "tomlkit",
    ),
    *("tyro", "rich.table", "rich.progress", "jinja2", "skimage.metrics"),
    *("invgraphics.cli.main", "invgraphics.cli.fit", "invgraphics.cli.report", "invgraphics.experiments.run"),
]

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(PRELOADED)


class Running:
    """A command that runs.

    Args:
        argv: arguments of ``invgraphics``.
        log: file for what it writes to the terminal.
        before: ``module:function`` to call in the process before the command.
        environment: variables to set.
    """

    def __init__(self, argv: Sequence[str], log: Path, before: str = "", environment: dict[str, str] | None = None) -> None:
        self.argv, self.log = tuple(argv), log
        arguments = (self.argv, str(log), before, str(Path.cwd()), environment or {})
        self._process: BaseProcess = _context.Process(target=_command, args=arguments)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.is_alive()

    def send(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.alive():
            os.kill(self.pid, number)

    def wait(self, seconds: float = 300) -> int:
        """Exit status, negative for a signal."""
        self._process.join(seconds)
        status = self._process.exitcode
        if status is None:
            self._process.kill()
            self._process.join()
            raise AssertionError(f"{' '.join(self.argv)} still ran after {seconds} s:\n{self.said()}")
        return status

    def said(self) -> str:
        """What it has written to the terminal."""
        return self.log.read_text(errors="replace") if self.log.is_file() else ""


def _command(argv: Sequence[str], log: str, before: str, folder: str, environment: dict[str, str]) -> None:
    os.chdir(folder)
    os.environ.update(environment)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if before:
        module, _, function = before.partition(":")
        getattr(importlib.import_module(module), function)()
    sys.argv = ["invgraphics", *argv]

    from invgraphics.cli.main import main

    main(argv)


def slowness() -> float:
    """How many times longer than on an idle machine a process takes at present: wall time of a busy loop over its CPU time."""
    wall, own = time.perf_counter(), time.process_time()
    while time.process_time() - own < 0.1:
        pass
    return max(1.0, (time.perf_counter() - wall) / 0.1)
