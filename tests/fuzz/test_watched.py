"""The bounds of time and memory that the fuzzer holds readers to, with a reader that breaks each of them."""

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="limits of memory are POSIX's")

import watched

SCRIPT = """
import sys, time, types
sys.path.insert(0, {folder!r})
sys.modules["torch"] = types.SimpleNamespace(set_num_threads=lambda count: None)  # a second to import, at each of three starts
import numpy as np, reader
from invgraphics.errors import InputError

def read(path):
    match path.name:
        case "takes":
            np.ones({much}, np.uint8)
        case "asks":  # for what is not there, and hides it in a sentence
            try:
                np.ones({too_much}, np.uint8)
            except MemoryError as error:
                raise InputError("It cannot be read.") from error
        case "takes-less":
            np.ones({less}, np.uint8)
        case "sleeps":
            time.sleep(60)
        case "computes":
            while True:
                pass
        case "ends":
            sys.stdout.flush()
            import os
            os._exit(3)
    return "fine"

reader.READERS["recipe"] = read
reader.main()
"""


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[watched.Process]:
    script = tmp_path_factory.mktemp("script") / "misbehaving.py"
    sizes = {"less": 3 << 28, "much": 3 << 29, "too_much": 3 << 30}
    script.write_text(SCRIPT.format(folder=str(Path(watched.__file__).parent), **sizes))
    started = watched.Process(script)
    yield started
    started.close()


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("good", "accepted"),
        ("takes-less", "accepted"),
        ("takes", "greedy"),
        ("asks", "raised"),
        ("sleeps", "hung"),
        ("computes", "hung"),
        ("ends", "died"),
    ],
)
def test_every_bound_is_noticed(process: watched.Process, name: str, outcome: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if outcome == "hung":
        monkeypatch.setattr(watched, "SECONDS", 1.0)
    reader = watched.Reader(process, "recipe", Path("good"))
    assert reader.read(Path(name))[0] == outcome
