"""Ends of processes: within two seconds of SIGTERM wherever they are, and with the process that started them."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import NoReturn

INTERRUPTED = 130
"""Exit status of a process that was interrupted or terminated."""
GRACE_SECONDS = 1.5
"""Time after SIGTERM in which a process may end by itself."""
WITH_PARENT = "--while-stdin-is-open"
"""Argument of programs that tie their life to that of the process that started them."""
GIVEN_UP = f"Terminated; not even a step was over within {GRACE_SECONDS:g} s. What was saved before remains."


class Terminated(KeyboardInterrupt):
    """SIGTERM came: unlike after Ctrl-C at a terminal, SIGKILL may follow within seconds."""

    raised = False
    """Whether it was ever raised in this process: a library that it passes through may turn it into an exception of its own."""


def terminate(number: int, frame: FrameType | None) -> None:
    """Handle a signal by raising `Terminated`; while modules are loaded, end the process instead.

    Extension modules do not survive exceptions in their initialisation: torch aborts, others are left half made.
    """
    if _importing(frame):
        _end_now("Terminated.")
    Terminated.raised = True
    raise Terminated


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _end_now(sentence: str) -> NoReturn:
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{sentence}\n".encode())
    os._exit(INTERRUPTED)


def end_on_sigterm() -> None:
    """Let SIGTERM raise `Terminated` in the main thread, and end the process after `GRACE_SECONDS` whatever comes of that.

    Python handles signals between two instructions of the main thread, which may be inside a compiler, a kernel or a library
    for longer; and an exception may be caught on its way. The operating system's handler itself writes to a pipe, which a
    thread reads. Where Python swallows the exception, in destructors and callbacks of weak references, the signal comes again;
    where nothing catches it, before a command begins or after it, the process ends with the same sentence and status.
    """
    sys.excepthook = _end_uncaught
    sys.unraisablehook = _raise_again
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    signal.set_wakeup_fd(sender, warn_on_full_buffer=False)
    threading.Thread(target=_end_later, args=(receiver,), daemon=True).start()
    signal.signal(signal.SIGTERM, terminate)  # last, so that all of the above is there when it raises


def _end_uncaught(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
    """End the process if nothing caught `Terminated`, for which Python's status would be 1; show other exceptions as usual."""
    if issubclass(kind, Terminated):
        _end_now("Terminated.")
    sys.__excepthook__(kind, error, where)


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Send SIGTERM again in a moment if its exception was swallowed; show other swallowed exceptions as usual."""
    if not issubclass(unraisable.exc_type, Terminated):
        sys.__unraisablehook__(unraisable)
        return
    again = threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGTERM))
    again.daemon = True
    again.start()


def _end_later(receiver: int) -> None:
    while number := os.read(receiver, 1):
        if number[0] == signal.SIGTERM:
            time.sleep(GRACE_SECONDS)
            _end_now(GIVEN_UP)


def end_with_parent() -> None:
    """Terminate this process when its standard input closes, as it does however the parent dies, if it was asked to."""
    if WITH_PARENT not in sys.argv[2:]:
        return

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin.read, whose lock would outlive the interpreter
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
