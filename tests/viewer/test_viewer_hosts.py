"""Requests under another site's name, or from its pages, are refused: DNS rebinding, with headers written to raw sockets."""

import base64
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser")

import websockets.asyncio.server
from websockets.datastructures import Headers

from invgraphics.errors import InputError
from invgraphics.viewer.host_check import HostCheck
from invgraphics.viewer.launch import ViewerConfig, open_viewer
from invgraphics.viewer.server import Viewer


@pytest.fixture(scope="module")
def viewer(runs: dict[str, Path]) -> Iterator[Viewer]:
    with open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0), print) as opened:
        yield opened


def _status(port: int, *headers: str, websocket: bool = False) -> int:
    """Status of the answer to a request with these headers and no others."""
    lines = ["GET / HTTP/1.1", *headers]
    if websocket:
        key = base64.b64encode(os.urandom(16)).decode()
        lines += ["Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13"]
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(connection.recv(4096).split()[1])


def test_pages_are_sent_under_the_viewers_own_names_only(viewer: Viewer) -> None:
    port = viewer.port
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"LOCALHOST:{port}", f"[::1]:{port}", "localhost", "localhost:9000"):
        assert _status(port, f"Host: {host}") == 200, host
    for host in (
        "evil.example",
        f"evil.example:{port}",
        f"localhost.evil.example:{port}",
        f"127.0.0.1.evil.example:{port}",
        "",
        "192.0.2.1",
    ):
        assert _status(port, f"Host: {host}") == 403, host
    for host in (
        f"localhost@evil.example:{port}",
        f"evil.example@localhost:{port}",
        "localhost/evil.example",
        "localhost:x",
        "[::1",
    ):
        assert _status(port, f"Host: {host}") == 403, host
    assert _status(port) == 403, "no Host"
    assert _status(port, "Host: localhost", "Host: evil.example") == 403
    assert _status(port, "Host: localhost", "Origin: http://evil.example") == 403


def test_handshakes_are_made_with_the_viewers_own_page_and_without_one(viewer: Viewer) -> None:
    port = viewer.port
    own = f"Host: localhost:{port}"
    assert _status(port, own, websocket=True) == 101, "a Python client"
    assert _status(port, own, f"Origin: http://localhost:{port}", websocket=True) == 101
    assert _status(port, "Host: localhost:9000", "Origin: http://localhost:9000", websocket=True) == 101, "a tunnel"
    for origin in (
        "http://evil.example",
        f"http://evil.example:{port}",
        "http://localhost:3000",
        "null",
        f"ftp://localhost:{port}",
    ):
        assert _status(port, own, f"Origin: {origin}", websocket=True) == 403, origin
    assert _status(port, f"Host: evil.example:{port}", f"Origin: http://evil.example:{port}", websocket=True) == 403
    assert _status(port, f"Host: evil.example:{port}", websocket=True) == 403


@pytest.mark.parametrize(
    ("listens", "host", "answered"),
    [
        ("gpu-box.example", "gpu-box.example:8080", True),
        ("gpu-box.example", "GPU-box.example", True),
        ("gpu-box.example", "other.example", False),
        ("gpu-box.example", "192.0.2.7:8080", False),
        ("192.0.2.7", "192.0.2.7:8080", True),
        ("192.0.2.7", "gpu-box.example:8080", False),
        ("0.0.0.0", "192.0.2.7:8080", True),  # no name, so none that could be rebound
        ("0.0.0.0", "evil.example:8080", False),
        ("0.0.0.0", f"{socket.gethostname()}:8080", True),
        ("::", "[2001:db8::7]:8080", True),
        ("::", "evil.example:8080", False),
    ],
)
def test_hosts_of_other_addresses(listens: str, host: str, answered: bool) -> None:
    assert (HostCheck(listens).refusal(Headers({"Host": host})) is None) is answered


def test_allowed_hosts(runs: dict[str, Path]) -> None:
    """Names of a proxy and of the machine around a container: pages, handshakes, and none but those names."""
    names = ("Viewer.example.org", "docker-box", "2001:db8::7")
    with open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0, allowed_hosts=names), print) as viewer:
        for host in ("viewer.example.org", "viewer.example.org:8443", "docker-box:9000", "[2001:db8::7]:80", "localhost"):
            assert _status(viewer.port, f"Host: {host}") == 200, host
        for host in ("evil.example", "example.org", "a.viewer.example.org", "192.0.2.1", "[2001:db8::8]"):
            assert _status(viewer.port, f"Host: {host}") == 403, host
        own = "Host: viewer.example.org"
        assert _status(viewer.port, own, "Origin: https://viewer.example.org", websocket=True) == 101, "a proxy with TLS"
        assert _status(viewer.port, own, "Origin: https://evil.example", websocket=True) == 403
    assert "--allow-host" in str(HostCheck("127.0.0.1").refusal(Headers({"Host": "docker-box"})))


@pytest.mark.parametrize("name", ["http://a.example", "a.example:80", "a/b", "", "*", "a b", "x@y", "*.example.org"])
def test_allowed_hosts_are_bare_names(runs: dict[str, Path], name: str) -> None:
    with pytest.raises(InputError, match="--allow-host cannot be"):
        open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0, allowed_hosts=(name,)), print)


def test_a_viser_that_cannot_be_checked_is_not_served(runs: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    infra = sys.modules["viser.infra._infra"]
    frozen = type(sys)("websockets")  # as if viser had looked its server up beforehand
    frozen.asyncio, frozen.datastructures = type(sys)("asyncio"), websockets.datastructures
    frozen.asyncio.server = type(sys)("server")
    vars(frozen.asyncio.server).update(vars(websockets.asyncio.server))
    frozen.exceptions = sys.modules["websockets.exceptions"]
    monkeypatch.setattr(infra, "websockets", frozen)
    with pytest.raises(InputError, match="cannot guard"):
        open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0), print)
