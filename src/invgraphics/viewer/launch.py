"""Opening runs and starting a viewer for them."""

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
from invgraphics.viewer.loaded_run import open_run

if TYPE_CHECKING:
    from invgraphics.viewer.server import Viewer


@dataclass(frozen=True)
class ViewerConfig:
    """Runs, address and initial view of a viewer.

    Attributes:
        runs: folders of one run or two; cameras are the first one's.
        live: wait for the first checkpoint.
        view: test view at which browsers start.
        host: address to listen at.
        port: port to listen at, 0 for any that is free.
        max_size: limit of the longer side, pixels.
        scene: another copy of the runs' scene.
        allowed_hosts: names besides ``host`` and this machine's own at which browsers may reach it.
    """

    runs: tuple[Path, ...]
    live: bool = False
    view: int = 0
    host: str = "127.0.0.1"
    port: int = 8080
    max_size: int = 800
    scene: str | None = None
    allowed_hosts: tuple[str, ...] = ()


def open_viewer(config: ViewerConfig, say: Callable[[str], None]) -> Viewer:
    """Open the runs and start the viewer.

    Args:
        config: runs and address.
        say: called with a sentence before each long wait.

    Raises:
        InputError: viser is missing, a run cannot be shown, the runs do not fit together, the address cannot be bound, or an
            allowed host is no bare name.
    """
    if importlib.util.find_spec("viser") is None:
        raise InputError("The viewer needs viser, which is not installed.", "`pip install 'invgraphics[viewer]'`")
    from invgraphics.viewer.host_check import allowed_host

    check_address(config.host, config.port)
    allowed = tuple(map(allowed_host, config.allowed_hosts))
    runs = [open_run(run, config.scene, config.live, say) for run in config.runs]
    names = [run.scene.name for run in runs]
    if len(set(names)) > 1:
        raise InputError(f"The runs show different scenes: {' and '.join(names)}.", "Two runs are compared on one scene.")
    count = len(runs[0].scene.test)
    if not 0 <= config.view < count:
        raise InputError(f"--view cannot be {config.view}.", f"Expected a test view, 0 to {count - 1}.")

    from invgraphics.viewer.server import Address, Viewer

    return Viewer(runs, Address(config.host, config.port, allowed), config.view, config.max_size)


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def url_host(host: str) -> str:
    """Host of a URL at which this machine's browser finds a server; of all interfaces, "localhost"."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if address.is_unspecified:
        return "localhost"
    return f"[{host}]" if address.version == 6 else host


def check_address(host: str, port: int) -> None:
    """Check that an address and port can be bound, before anything is loaded.

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
    except UnicodeError as error:  # a name that the domain name system could not have
        raise InputError(f"--host cannot be '{host[:80]}'.", "Expected an address of this machine.") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(
                f"Port {port} at {host} is in use.", "Choose another --port, or 0 for any that is free."
            ) from error
        if error.errno == errno.EACCES:
            raise InputError(f"Port {port} may not be used by you.", "Choose a --port above 1023.") from error
        raise InputError(f"--host cannot be '{host}': {error.strerror}.", "Expected an address of this machine.") from error
