"""Checks of the Host and Origin headers of HTTP requests and WebSocket handshakes, against DNS rebinding.

A page of another site can let its own name resolve to this machine; a browser then sends that page's requests here, with the
page's name as Host. Imports websockets, which comes with viser.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from invgraphics.errors import InputError

LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Host names at which every viewer answers; through a tunnel (``ssh -L``) with any port."""

ProcessRequest = Callable[[ServerConnection, Request], "Awaitable[Response | None] | Response | None"]


@dataclass
class HostCheck:
    """Host names at which a server answers.

    Attributes:
        host: address or name at which it listens. If that is every address (``0.0.0.0``, ``::``), it answers at numeric
            addresses, which cannot be rebound, and at this machine's name.
        allowed: further names, lower case, as of a proxy or of the machine whose port is mapped to a container's.
        active: whether a server has been started with the check, see `applied`.
    """

    host: str
    allowed: tuple[str, ...] = ()
    active: bool = field(default=False, init=False)

    def refusal(self, headers: Headers) -> str | None:
        """The sentence with which a request is refused, or ``None`` for one that is answered.

        Args:
            headers: those of the request. Without Origin, as Python clients send them, Host alone decides.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_allowed(hosts[0]):
            shown = "', '".join(hosts)[:100]
            return f"This viewer does not answer at '{shown}'. Use localhost, or start it with --allow-host and that name."
        if any(not _is_same(origin, hosts[0]) for origin in origins):
            return "This viewer does not answer pages of other sites."
        return None

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Apply the check to every websockets server that is started within the context, before its own ``process_request``.

        Viser starts its server in its constructor and passes on no ``process_request``, so the public entry point
        `websockets.asyncio.server.serve` is exchanged for that time. `active` reports afterwards whether the check is in place.
        """
        serve = websockets.asyncio.server.serve

        def checked(*args: Any, process_request: ProcessRequest | None = None, **settings: Any) -> Any:
            self.active = True
            return serve(*args, process_request=self._before(process_request), **settings)

        websockets.asyncio.server.serve = checked  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve

    def _before(self, process_request: ProcessRequest | None) -> ProcessRequest:
        def process(connection: ServerConnection, request: Request) -> Awaitable[Response | None] | Response | None:
            sentence = self.refusal(request.headers)
            if sentence is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, sentence + "\n")
            return process_request(connection, request) if process_request is not None else None

        return process

    def _is_allowed(self, header: str) -> bool:
        name = _name_of(header)
        if name is None:
            return False
        if name in LOOPBACK or name == self.host.lower() or name in self.allowed:
            return True
        own = _address(self.host)
        if own is None or not own.is_unspecified:
            return False
        return _address(name) is not None or name in (socket.gethostname().lower(), socket.getfqdn().lower())


def allowed_host(name: str) -> str:
    """A name or address as `HostCheck.allowed` holds it.

    Raises:
        InputError: it is no bare host name or address, as one with a port or a scheme.
    """
    bare = name.strip()
    found = _name_of(f"[{bare}]" if bare.count(":") > 1 and not bare.startswith("[") else bare)
    if found is None or found != bare.strip("[]").lower() or not all(each.isalnum() or each in "-._:%" for each in found):
        raise InputError(f"--allow-host cannot be '{name[:80]}'.", "Expected a name without port, as viewer.example.org.")
    return found


def _name_of(header: str) -> str | None:
    """The host in a Host header, in lower case, without port and brackets; ``None`` if the header is malformed."""
    try:
        parts = urlsplit(f"//{header}")
        _ = parts.port  # refuses what is no number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == header and "@" not in header else None


def _is_same(origin: str, host: str) -> bool:
    """Whether an Origin header names a page of ``host``, port included."""
    scheme, separator, rest = origin.lower().partition("://")
    return bool(separator) and scheme in ("http", "https") and rest == host.lower()


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
