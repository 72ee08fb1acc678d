"""Opens runs, and a viewer for them."""

from __future__ import annotations

import errno
import importlib.util
import ipaddress
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from invgraphics.errors import InputError
from invgraphics.viewer.subject import open_subject

if TYPE_CHECKING:
    from invgraphics.viewer.server import Viewer


@dataclass(frozen=True)
class ViewRequest:
    """What to look at, and where.

    Attributes:
        runs: folders of one run or two; cameras are the first one's.
        live: wait for a first checkpoint.
        view: test view at which browsers start.
        host: address to listen at.
        port: port to listen at, 0 for any that is free.
        longest: most pixels along a picture's longest side.
        scene: another copy of the runs' scene.
    """

    runs: tuple[Path, ...]
    live: bool = False
    view: int = 0
    host: str = "127.0.0.1"
    port: int = 8080
    longest: int = 800
    scene: str | None = None


def open_viewer(request: ViewRequest, say: Callable[[str], None]) -> Viewer:
    """Open the runs and start the viewer.

    Args:
        request: what to look at.
        say: told what takes long, in sentences.

    Raises:
        InputError: viser is missing, a run cannot be looked at, the runs do not fit together, or nobody can listen there.
    """
    if importlib.util.find_spec("viser") is None:
        raise InputError("The viewer needs viser, which is not installed.", "`pip install 'invgraphics[viewer]'`")
    check_place(request.host, request.port)
    subjects = [open_subject(run, request.scene, request.live, say) for run in request.runs]
    names = [subject.scene.name for subject in subjects]
    if len(set(names)) > 1:
        raise InputError(f"The runs show different scenes: {' and '.join(names)}.", "Two runs are compared on one scene.")
    count = len(subjects[0].scene.test)
    if not 0 <= request.view < count:
        raise InputError(f"--view cannot be {request.view}.", f"Expected a test view, 0 to {count - 1}.")

    from invgraphics.viewer.server import Place, Viewer

    return Viewer(subjects, Place(request.host, request.port), request.view, request.longest)


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_place(host: str, port: int) -> None:
    """See that somebody can listen at an address and port, before anything is loaded.

    Raises:
        InputError: it is in use, not allowed, or no address of this machine.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port cannot be {port}.", "Expected 1 to 65535, or 0 for any port that is free.")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen(1)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(
                f"Port {port} at {host} is in use.", "Choose another --port, or 0 for any that is free."
            ) from error
        if error.errno == errno.EACCES:
            raise InputError(f"Port {port} may not be used by you.", "Choose a --port above 1023.") from error
        raise InputError(f"--host cannot be '{host}': {error.strerror}.", "Expected an address of this machine.") from error
