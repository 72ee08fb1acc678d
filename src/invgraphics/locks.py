"""Exclusive locks on what a process writes, held by the operating system: however the process ends, its locks end with it."""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from invgraphics.errors import InputError

INSIDE = ".lock"
"""Lock file of a folder that is written file by file."""
ORPHAN_SECONDS = 10.0
"""Longest wait for the child processes of a holder that died, which keep its lock until they have ended."""
SIGNATURE_SECONDS = 1.0
"""Longest wait for the name of a holder that has locked the file but not yet signed it."""
POLL_SECONDS = 0.05


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock.

    Attributes:
        pid: process number, 0 where unknown.
        host: on which it runs.
        since: date and time, UTC.
    """

    pid: int = 0
    host: str = ""
    since: str = ""

    @staticmethod
    def here() -> Holder:
        """This process, from now on."""
        return Holder(os.getpid(), socket.gethostname(), f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M:%S} UTC")

    @property
    def dead(self) -> bool:
        """Whether the process is known to have ended: it ran on this host and does no longer."""
        if not self.pid or self.host != socket.gethostname():
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            pass
        return False

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}" if self.pid else "another process"


_held: dict[Path, tuple[int, int]] = {}
"""Lock file -> thread and descriptor of the locks of this process."""


@contextmanager
def locked(what: Path, file: Path | None = None, waiting: Callable[[Holder], None] | None = None) -> Iterator[int]:
    """Hold the exclusive lock of a folder or file that is about to be written; nests within a thread.

    Args:
        what: the folder or file.
        file: the lock file; ``None`` for one beside ``what``, as it is replaced as a whole. Its folder must exist.
        waiting: called once with the holder before waiting for it; ``None`` refuses instead.

    Yields:
        The lock's descriptor; a child process that inherits it keeps the lock until it ends, too.

    Raises:
        InputError: another process holds it, and ``waiting`` is ``None``; or the file system has no locks.
    """
    file = what.absolute().with_name(f".{what.absolute().name}.lock") if file is None else file
    key = file.parent.resolve() / file.name
    thread, descriptor = _held.get(key, (None, -1))
    if thread == threading.get_ident():
        yield descriptor
        return
    descriptor = _acquire(what, key, waiting)
    _held[key] = (threading.get_ident(), descriptor)
    try:
        yield descriptor
    finally:
        del _held[key]
        with contextlib.suppress(OSError):
            if _is_current(descriptor, key):  # the folder may have been removed, and made again by another process
                key.unlink()  # before it is freed: whoever opened this file finds out that it is no longer the one
        os.close(descriptor)


def _acquire(what: Path, file: Path, waiting: Callable[[Holder], None] | None) -> int:
    """Open and lock ``file``; returns its descriptor."""
    began, notified = time.monotonic(), False
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        if _is_free(descriptor, what):
            if _is_current(descriptor, file):
                _sign(descriptor)
                return descriptor
            os.close(descriptor)
            continue
        holder = _holder(descriptor)
        os.close(descriptor)
        if not holder.pid and time.monotonic() < began + SIGNATURE_SECONDS:
            time.sleep(POLL_SECONDS)
            continue
        if waiting is not None and not notified:
            waiting(holder)
            notified = True
        if waiting is None and not (holder.dead and time.monotonic() < began + ORPHAN_SECONDS):
            raise InputError(f"{what} is being written by {holder}.", "Wait for its end, or choose another --out.")
        time.sleep(POLL_SECONDS)


def _is_free(descriptor: int, what: Path) -> bool:
    """Lock an open file, unless another process has."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        os.close(descriptor)
        sentence = f"{what} cannot be locked: {error.strerror}."
        raise InputError(sentence, "Choose an --out on another file system.") from error
    return True


def _is_current(descriptor: int, file: Path) -> bool:
    """Whether ``file`` is still the file that was opened, and not removed by its last holder."""
    try:
        return os.path.samestat(os.fstat(descriptor), file.stat())
    except FileNotFoundError:
        return False


def _sign(descriptor: int) -> None:
    """Write who holds the lock into its file; a full disk leaves it empty."""
    holder = Holder.here()
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{holder.pid}\n{holder.host}\n{holder.since}".encode(), 0)


def _holder(descriptor: int) -> Holder:
    try:
        pid, host, since = os.pread(descriptor, 1000, 0).decode().split("\n")
        return Holder(int(pid), host, since)
    except (OSError, ValueError):
        return Holder()
