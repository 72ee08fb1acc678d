"""Worker processes' work, done in the process of the tests: importing what it needs takes longer than most of it."""

from __future__ import annotations

import contextlib
import io
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from invgraphics.scenes.process import Progress


def run_here(module: str, folder: Path, progress: Progress, **_: Any) -> None:
    """`run_worker` without a process: its errors are raised as they are, its progress comes when all is done."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        import_module(module).main(folder)
    for line in output.getvalue().splitlines():
        word, done, total, what = line.split(" ", 3)
        assert word == "progress"
        progress(int(done), int(total), what)


def work_here(patch: pytest.MonkeyPatch) -> None:
    """Let both makers of scenes work in this process."""
    for maker in ("mitsuba", "photos"):
        patch.setattr(f"invgraphics.scenes.{maker}.maker.run_worker", run_here)
