"""Forecast of a rendering's duration from the time of its first view."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from invgraphics.scenes.mitsuba.folder import view_paths
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.rig import SPLITS, Split
from invgraphics.scenes.process import Progress
from invgraphics.thread_pools import usable_cores

SETTLED_SECONDS = 5.0
"""A first view that takes less is mostly compilation: then the second one is timed."""


class RenderingForecast:
    """Progress callback that forecasts the remaining duration once, from the time of the first view.

    Args:
        job: what is rendered.
        folder: where; views that it holds cost nothing.
        progress: called with all that comes.
        say: takes the sentence.
        clock: seconds that pass.
    """

    def __init__(
        self,
        job: Job,
        folder: Path,
        progress: Progress,
        say: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._job, self._progress, self._say, self._clock = job, progress, say, clock
        self._left = {
            f"{split} {index:04d}": getattr(job.samples, split)
            for split in SPLITS
            for index in range(getattr(job.views, split))
            if not _is_there(folder, split, index)
        }
        self._pending = len(self._left)
        self._view = ""
        self._began = 0.0
        self._timed = 0
        self._reported = self._pending == 0

    def __call__(self, done: int, total: int, what: str) -> None:
        """Receive progress: ``what`` begins now, and its predecessor is finished."""
        now = self._clock()
        if not self._reported and self._view in self._left:
            self._finish(self._view, now - self._began)
        self._view, self._began = what, now
        self._progress(done, total, what)

    def _finish(self, view: str, seconds: float) -> None:
        samples = self._left.pop(view)
        self._timed += 1
        if self._timed == 1 and seconds < SETTLED_SECONDS and self._left:
            return
        self._reported = True
        left = seconds * sum(self._left.values()) / samples
        threads = usable_cores()
        width, height = self._job.size
        length = f"{left:.0f} s" if left < 100 else f"{left / 60:.0f} min" if left < 6000 else f"{left / 3600:.1f} h"
        self._say(
            f"{self._job.spec.name} at {width}x{height}: {self._pending} views, about {length} on {threads} "
            f"thread{'s' if threads > 1 else ''}; cached afterwards."
        )


def _is_there(folder: Path, split: Split, index: int) -> bool:
    return view_paths(folder, split, index)[1].exists()
