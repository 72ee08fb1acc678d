"""The single render thread: newest task of each key, in slices.

Kernels use all cores already, and a model must not be rendered while it is reloaded, so one thread does all work in turn. Tasks
are generators: a cancelled task is closed between two slices, so that what it holds (a film's encoder and folder) goes at once.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterator
from dataclasses import dataclass

Task = Iterator[float]
"""Generator that yields after each slice of work the seconds to wait before it is resumed."""


@dataclass(eq=False)
class _Entry:
    task: Task
    ready: float
    slices: int = 0
    cancelled: bool = False


class RenderThread(threading.Thread):
    """Runs the newest task of each key, slice by slice; tasks with fewer finished slices go first.

    A newer task replaces the one of its key after the slice that is running.

    Args:
        on_error: called with the key and the exception of a task that failed; the thread goes on.
    """

    def __init__(self, on_error: Callable[[Hashable, Exception], None]) -> None:
        super().__init__(name="viewer-renders", daemon=True)
        self._on_error = on_error
        self._entries: dict[Hashable, _Entry] = {}
        self._cancelled: list[tuple[Hashable, _Entry]] = []
        self._changed = threading.Condition()
        self._ended = False

    def submit(self, key: Hashable, task: Task) -> None:
        """Schedule ``task`` in place of any other of the same key."""
        with self._changed:
            self._drop(key)
            self._entries[key] = _Entry(task, time.monotonic())
            self._changed.notify_all()

    def cancel(self, key: Hashable) -> None:
        """Remove the task of a key, if there is one."""
        with self._changed:
            self._drop(key)
            self._changed.notify_all()

    def at_work(self) -> list[Hashable]:
        """Keys of the tasks that have finished a slice and wait for nothing but their turn; those in a pause are left out."""
        with self._changed:
            now = time.monotonic()
            return [key for key, entry in self._entries.items() if entry.slices and entry.ready <= now]

    def _drop(self, key: Hashable) -> None:
        """Leave the task of a key, which may be running, to `run` to close."""
        if (entry := self._entries.pop(key, None)) is not None:
            entry.cancelled = True
            self._cancelled.append((key, entry))

    def stop(self) -> None:
        """Stop and join the thread after the slice that is running."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        """Run tasks until `stop`, and close those that end unfinished."""
        while (found := self._await()) is not None:
            key, entry = found
            if entry.cancelled:
                self._advance(key, _closing(entry.task))
                continue
            pause = self._advance(key, entry.task)
            with self._changed:
                if self._entries.get(key) is not entry:
                    continue
                if pause is None:
                    del self._entries[key]
                else:
                    entry.ready, entry.slices = time.monotonic() + pause, entry.slices + 1

        for key, entry in (*self._cancelled, *self._entries.items()):
            self._advance(key, _closing(entry.task))

    def _advance(self, key: Hashable, task: Task) -> float | None:
        """Run a slice of a task; ``None`` if it was the last."""
        try:
            return next(task, None)
        except Exception as error:  # one failed image must not end the viewer
            self._on_error(key, error)
            return None

    def _await(self) -> tuple[Hashable, _Entry] | None:
        """Wait for a task that is due or cancelled; ``None`` after `stop`."""
        with self._changed:
            while not self._ended:
                if self._cancelled:
                    return self._cancelled.pop()
                now = time.monotonic()
                ready = [(key, entry) for key, entry in self._entries.items() if entry.ready <= now]
                if ready:
                    return min(ready, key=lambda pair: (pair[1].slices, pair[1].ready))
                times = [entry.ready - now for entry in self._entries.values()]
                self._changed.wait(min(times) if times else None)
            return None


def _closing(task: Task) -> Task:
    """A task that ends another one where it stands."""
    if isinstance(task, Generator):
        task.close()
    yield from ()
