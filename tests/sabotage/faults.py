"""What happens to a command at a moment: killed, terminated, stopped, a full disk, lost permissions, a rival."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from commands import Case
from processes import Running, slowness

Fault = Callable[[Case, Path, float], str]
"""Starts a case in a folder, does something to it after so many seconds, and waits for its end; returns what was seen.

An `AssertionError` says what should not have been.
"""

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130
TERMINATION_SECONDS = 2.0


def kill(case: Case, place: Path, seconds: float) -> str:
    """SIGKILL."""
    process = _until(case.start(place), seconds)
    process.send(signal.SIGKILL)
    return f"status {_expect(process, -signal.SIGKILL, DONE)}"


def terminate(case: Case, place: Path, seconds: float) -> str:
    """SIGTERM, whose two seconds are multiplied by how much slower than idle the machine is."""
    process = _until(case.start(place), seconds)
    slow, began = slowness(), time.monotonic()
    process.send(signal.SIGTERM)
    status, took = _expect(process, INTERRUPTED, -signal.SIGTERM, DONE), time.monotonic() - began
    assert took < TERMINATION_SECONDS * slow, f"SIGTERM took {took:.1f} s on a machine {slow:.1f} times slower than idle"
    return f"status {status} in {took:.1f} s"


def stop(case: Case, place: Path, seconds: float) -> str:
    """SIGSTOP, and SIGCONT half a second later."""
    process = _until(case.start(place), seconds)
    process.send(signal.SIGSTOP)
    time.sleep(0.5)
    process.send(signal.SIGCONT)
    return f"status {_expect(process, DONE)}"


def full_disk(case: Case, place: Path, seconds: float) -> str:
    """No byte left on the disk."""
    process = _until(case.start(place), seconds)
    ballast = place / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            with contextlib.suppress(OSError):
                while file.write(bytes(size)) == size:
                    pass
    status = process.wait()
    ballast.unlink()
    return f"status {_check(process, status, DONE, 1, BAD_INPUT)}"


def no_permission(case: Case, place: Path, seconds: float) -> str:
    """No folder can be written any more."""
    process = _until(case.start(place, before=f"{__name__}:drop_privileges"), seconds)
    folders = [place, *(path for path in place.rglob("*") if path.is_dir())]
    for folder in folders:
        with contextlib.suppress(FileNotFoundError):
            folder.chmod(0o555)
    status = process.wait()
    for folder in [place, *(path for path in place.rglob("*") if path.is_dir())]:
        folder.chmod(0o755)
    return f"status {_check(process, status, DONE, 1, BAD_INPUT)}"


def race(case: Case, place: Path, seconds: float) -> str:
    """The same command a second time."""
    first = _until(case.start(place), seconds)
    second = case.start(place, log="log2")
    statuses = _expect(first, DONE, BAD_INPUT), _expect(second, DONE, BAD_INPUT)
    assert DONE in statuses, f"{first.said()}\n{second.said()}"
    return f"statuses {statuses[0]} and {statuses[1]}"


def faults() -> dict[str, Fault]:
    """What can be done here: full disks and lost permissions need a mount and capabilities."""
    found: dict[str, Fault] = {"kill": kill, "terminate": terminate, "stop": stop, "race": race}
    if os.geteuid() != 0:
        return found | {"no permission": no_permission}
    return found | {"full disk": full_disk, "no permission": no_permission}


@contextmanager
def small_disk(place: Path, size: str = "64m") -> Iterator[None]:
    """A file system of its own at ``place``; none where mounting is not allowed.

    Raises:
        PermissionError: it is not.
    """
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], check=False).returncode:
        raise PermissionError
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def drop_privileges() -> None:
    """Obey permissions of files, as root too; programs that are started from here do as well."""
    if os.geteuid() != 0:
        return
    override, search, owner = 1, 2, 3
    library = ctypes.CDLL(None, use_errno=True)
    for capability in (override, search, owner):
        library.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    data = (ctypes.c_uint32 * 6)()
    assert library.capget(header, data) == 0
    for word in (0, 1):  # effective, permitted
        data[word] &= ~sum(1 << capability for capability in (override, search, owner))
    assert library.capset(header, data) == 0


def _until(process: Running, seconds: float) -> Running:
    """Let a process run for so long, or until it ends."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.alive():
        time.sleep(0.005)
    return process


def _expect(process: Running, *statuses: int) -> int:
    return _check(process, process.wait(), *statuses)


def _check(process: Running, status: int, *statuses: int) -> int:
    """One of the expected statuses, and no fault that is called one of our own."""
    assert status in statuses, f"status {status}:\n{process.said()}"
    assert "Traceback" not in process.said() and "fault of invgraphics" not in process.said(), process.said()
    return status
