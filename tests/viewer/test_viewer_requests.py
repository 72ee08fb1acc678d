"""What cannot be looked at gets a sentence, before anything is loaded or served."""

import contextlib
import importlib.util
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from training_fixtures import SMALL

from invgraphics.cli import main, view
from invgraphics.errors import InputError
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.viewer.launch import ViewerConfig, check_address, is_loopback, open_viewer, url_host
from invgraphics.viewer.loaded_run import open_run


def _refused(words: list[str], sentence: str, capsys) -> None:
    assert main.run(["view", *words]) == main.BAD_INPUT
    said = capsys.readouterr().err.splitlines()
    assert any(sentence in line for line in said) and len(said) <= main.MOST_LINES, said


def test_bad_arguments(runs: dict[str, Path], tmp_path: Path, capsys) -> None:
    run = str(runs["volumetric/hash"])
    _refused([str(tmp_path)], "is not a run", capsys)
    _refused([run, str(tmp_path / "none")], "is not a run", capsys)
    _refused([run, "--view", "99", "--port", "0"], "--view cannot be 99", capsys)
    _refused([run, "--max-size", "2"], "--max-size cannot be 2", capsys)
    _refused([run, "--port", "70000"], "--port cannot be 70000", capsys)
    _refused([run, "--host", "no.such.host.invalid"], "--host cannot be 'no.such.host.invalid'", capsys)
    _refused([run, "--host", "a" * 64], f"--host cannot be '{'a' * 64}'", capsys)  # longer than a name's part can be
    _refused([run, "--host", "192.0.2.1"], "--host cannot be '192.0.2.1'", capsys)  # an address of nobody (RFC 5737)


def test_a_port_in_use(runs: dict[str, Path], capsys) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        port = taken.getsockname()[1]
        _refused([str(runs["volumetric/hash"]), "--port", str(port)], f"Port {port} at 127.0.0.1 is in use", capsys)
    check_address("127.0.0.1", port)


def test_without_viser(runs: dict[str, Path], monkeypatch, capsys) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else find(name))
    _refused([str(runs["volumetric/hash"])], "needs viser, which is not installed", capsys)


def test_a_run_without_checkpoint_is_refused_or_awaited(runs: dict[str, Path], tmp_path: Path, capsys) -> None:
    run = Path(shutil.copytree(runs["volumetric/hash"], tmp_path / "run"))
    (run / CHECKPOINT).rename(tmp_path / "later")
    _refused([str(run), "--port", "0"], "has no checkpoint yet", capsys)
    said = []
    timer = threading.Timer(0.3, lambda: (tmp_path / "later").rename(run / CHECKPOINT))
    timer.start()
    assert open_run(run, None, live=True, say=said.append).steps == 150
    assert len(said) == 1 and "Waiting for a fit" in said[0]


def test_runs_of_different_scenes(runs: dict[str, Path], toy_folder: Path, tmp_path: Path) -> None:
    method = "splatting/gaussians"
    request = FitRequest(
        method=method, scene=str(toy_folder), out=str(tmp_path / "b"), budget="1steps", overrides=tuple(SMALL[method])
    )
    with pytest.raises(InputError, match="different scenes"):
        open_viewer(ViewerConfig((runs[method], fit_run(request)), port=0), print)


def test_a_checkpoint_of_another_recipe(runs: dict[str, Path], tmp_path: Path, capsys) -> None:
    run = Path(shutil.copytree(runs["volumetric/hash"], tmp_path / "run"))
    loaded = open_run(run, None, live=False, say=print)
    shutil.copy(runs["volumetric/nerf"] / CHECKPOINT, run / CHECKPOINT)
    assert loaded.has_update()
    with pytest.raises(InputError, match="has become another run"):
        loaded.reload()
    assert not loaded.has_update(), "said once"


@pytest.mark.parametrize(("host", "answer"), [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False)])
def test_loopback(host: str, answer: bool) -> None:
    assert is_loopback(host) is answer


@pytest.mark.parametrize(
    ("listens", "opened"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("::1", "[::1]"),
        ("localhost", "localhost"),
        ("0.0.0.0", "localhost"),
        ("::", "localhost"),
        ("192.0.2.2", "192.0.2.2"),
        ("fe80::1", "[fe80::1]"),
        ("desk.lan", "desk.lan"),
    ],
)
def test_the_address_that_is_printed_is_served(listens: str, opened: str) -> None:
    assert url_host(listens) == opened


def test_the_page_is_opened_where_there_is_a_screen_only(monkeypatch) -> None:
    monkeypatch.setattr(view.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert not view._has_screen()
    monkeypatch.setenv("DISPLAY", ":0")
    assert view._has_screen()


@contextlib.contextmanager
def ended(process: subprocess.Popen) -> Iterator[None]:
    """Whatever happens, the process ends."""
    try:
        yield
    finally:
        process.kill()


def test_the_command_serves_this_machine_until_it_is_interrupted(runs: dict[str, Path]) -> None:
    words = [sys.executable, "-m", "invgraphics", "view", str(runs["volumetric/hash"]), "--port", "0", "--no-open"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process, ended(process):
        line = process.stdout.readline()
        port = int(re.search(r"http://127.0.0.1:(\d+) \(Ctrl-C to stop\)", line).group(1))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as page:
            assert b"<title>" in page.read()
        # Linux answers at all of 127.0.0.0/8, so this is another address of this machine.
        with socket.socket() as other, pytest.raises(ConnectionRefusedError):
            other.connect(("127.0.0.2", port))
        process.send_signal(signal.SIGTERM)  # like Ctrl-C, which a shell in the background ignores
        said, complained = process.communicate(timeout=60)
        assert (process.returncode, said, complained) == (main.DONE, "", "")


def test_nobody_can_ask_to_open_it_to_the_internet(runs: dict[str, Path]) -> None:
    with open_viewer(ViewerConfig((runs["volumetric/hash"],), port=0), print) as viewer:
        assert viewer._server.request_share_url() is None and viewer._server._share_tunnel is None
