"""The one thread that renders.

Kernels use all cores as it is, and a model that is reloaded must not be rendered meanwhile, so all work is done in turn by one
thread, in pieces. Work is cut short by not asking for its next piece.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

Job = Iterator[float]
"""Work in pieces; after each it yields the seconds that may pass before the next one (0: go on)."""


@dataclass(eq=False)
class _Entry:
    job: Job
    ready: float
    pieces: int = 0


class Worker(threading.Thread):
    """Does the newest job of each key, piece by piece.

    A job that replaces another of its key ends it after the piece that is being done; every job's first piece is done unless a
    newer one of its key comes first. Jobs that have just begun go before those that refine.

    Args:
        complain: called with the key and the error of a job that failed; the thread goes on.
    """

    def __init__(self, complain: Callable[[Hashable, Exception], None]) -> None:
        super().__init__(name="viewer-renders", daemon=True)
        self._complain = complain
        self._entries: dict[Hashable, _Entry] = {}
        self._news = threading.Condition()
        self._ended = False

    def submit(self, key: Hashable, job: Job) -> None:
        """Do ``job`` as soon as possible, in place of any other of the same key."""
        with self._news:
            self._entries[key] = _Entry(job, time.monotonic())
            self._news.notify_all()

    def forget(self, key: Hashable) -> None:
        """Drop the job of a key, if there is one."""
        with self._news:
            self._entries.pop(key, None)
            self._news.notify_all()

    def stop(self) -> None:
        """End after the piece that is being done."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        """Work until `stop`."""
        while (found := self._await()) is not None:
            key, entry = found
            try:
                pause = next(entry.job, None)
            except Exception as error:  # one picture that fails must not end the viewer
                self._complain(key, error)
                pause = None
            with self._news:
                if self._entries.get(key) is not entry:
                    continue
                if pause is None:
                    del self._entries[key]
                else:
                    entry.ready, entry.pieces = time.monotonic() + pause, entry.pieces + 1

    def _await(self) -> tuple[Hashable, _Entry] | None:
        """The entry to go on with, when there is one; ``None`` at the end."""
        with self._news:
            while not self._ended:
                now = time.monotonic()
                ready = [(key, entry) for key, entry in self._entries.items() if entry.ready <= now]
                if ready:
                    return min(ready, key=lambda pair: (pair[1].pieces, pair[1].ready))
                times = [entry.ready - now for entry in self._entries.values()]
                self._news.wait(min(times) if times else None)
            return None
