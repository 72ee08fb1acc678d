"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


class Reporter:
    """Progress display on stderr, which leaves stdout to results.

    Args:
        title: what is being done.
        quiet_seconds: shortest time between two plain lines where there is no terminal.
    """

    def __init__(self, title: str, quiet_seconds: float = 10.0) -> None:
        self._title, self._quiet = title, quiet_seconds
        self._last = 0.0
        self._bar: Progress | None = None
        self._task = TaskID(0)

    def __enter__(self) -> Self:
        console = Console(stderr=True)
        if console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
            self._bar = Progress(*columns, console=console, transient=True)
            self._task = self._bar.add_task(self._title, total=1.0, note="")
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, fraction: float, note: str) -> None:
        """Update the display: ``fraction`` of the work is done."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, completed=fraction, note=note)
        elif now - self._last >= self._quiet or fraction >= 1:
            self._last = now
            print(f"{self._title}: {100 * fraction:3.0f} %  {note}", file=sys.stderr, flush=True)


def warn(sentence: str) -> None:
    """Print a warning to stderr, in red on a terminal."""
    Console(stderr=True, highlight=False, markup=False).print(sentence, style="bold red", soft_wrap=True)
