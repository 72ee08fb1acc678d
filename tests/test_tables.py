"""Limits of what is read from files: size, depth, digits, and headers that claim more than there is."""

import ast
import io
import re
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import invgraphics
from invgraphics import arrays, memory, tables
from invgraphics.arrays import read_array, read_arrays
from invgraphics.errors import InputError
from invgraphics.tables import parse_toml, read_json, read_toml

SOURCES = Path(invgraphics.__file__).parent


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[" * 100_000 + "]" * 100_000, "more than 64 deep"),
        ("[" * 80 + "]" * 80, "more than 64 deep"),
        ('{"w": ' + "1" * 6000 + "}", "6000 digits"),
        ('{"w": ' + "-" + "1" * 400 + "}", "401 digits"),
        ('{"w": }', "line 1, column 7"),
        ('["\\ud83d", 1]', "surrogates not allowed"),
        ("", "line 1, column 1"),
    ],
)
def test_json_is_read_within_limits(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_json(tmp_path / "a.json")


def test_json_at_the_limits_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[" * 64 + "12345678901234567890" + "]" * 64)
    value = read_json(tmp_path / "a.json")
    for _ in range(64):
        (value,) = value
    assert value == 12345678901234567890


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'{"a": "\xff"}')
    with pytest.raises(InputError, match="byte 7"):
        read_json(tmp_path / "a.json")
    with pytest.raises(InputError, match="does not exist"):
        read_json(tmp_path / "b.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_toml(tmp_path)
    with (tmp_path / "long.toml").open("wb") as file:
        file.truncate(1 << 31)  # sparse
    with pytest.raises(InputError, match="longer than 1 MB"):
        read_toml(tmp_path / "long.toml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a." * 20_000 + "a = 1", "dotted key"),  # tomllib alone: 10 s, and gigabytes for ten times as many
        ("a = " + "[" * 20_000 + "]" * 20_000, "more than 64 deep"),
        ("a = " + "[" * 80 + "]" * 80, "more than 64 deep"),
        ("a = " + "1" * 6000, "digits"),
        ("a = '" + "word" * 250_000, "Expected"),
        ("a = 123456789012345678901234567890", "more than 20 digits"),
        ("a = ", "Invalid value"),
    ],
)
def test_toml_is_read_within_limits(text: str, sentence: str) -> None:
    began = time.process_time()
    with pytest.raises(InputError, match=sentence):
        parse_toml(text, "a.toml")
    assert time.process_time() - began < 2


def npy(header: str, body: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body


def saved(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


BAD_ARRAYS: dict[str, tuple[Callable[[], bytes], str]] = {
    "more than there is": (lambda: npy("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,)}\n"), "claims"),
    "less than there is": (lambda: saved(np.arange(4.0)) + b"more", "claims"),
    "negative": (lambda: npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -1)}\n", bytes(8)), "claims"),
    "pickle": (lambda: npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n", bytes(8)), "neither numbers nor text"),
    "nested header": (lambda: npy("(" * 9000), "cannot be read"),
    "long header": (lambda: npy(" " * 20_000), "its header has 20000 bytes"),
    "no header": (lambda: npy("nothing"), "cannot be read"),
    "no array": (lambda: b"PK\x03\x04 and so on", "no NumPy array"),
    "cut off": (lambda: saved(np.arange(4.0))[:-5], "claims"),
}


@pytest.mark.parametrize("name", BAD_ARRAYS)
def test_array_headers_are_compared_with_what_follows(tmp_path: Path, name: str) -> None:
    make, sentence = BAD_ARRAYS[name]
    (tmp_path / "a.npy").write_bytes(make())
    with pytest.raises(InputError, match=sentence) as caught:
        read_array(tmp_path / "a.npy")
    assert "--size" not in str(caught.value)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", make())
    with pytest.raises(InputError, match="cannot be read"):
        read_arrays(tmp_path / "a.npz")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (3, 5), (2, 3, 4)])
def test_arrays_are_what_numpy_saved(tmp_path: Path, shape: tuple[int, ...], order: str) -> None:
    array = np.asarray(np.random.default_rng(0).normal(size=shape), order=order)  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", x=array, text=np.array("word"))
    np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), array)
    loaded = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded["x"], array)
    assert loaded["text"].item() == "word" and loaded["x"].flags.writeable


def test_every_flipped_bit_of_an_archive_is_noticed(tmp_path: Path) -> None:
    array = np.random.default_rng(0).integers(0, 256, (40, 40), dtype=np.uint8)
    np.savez(tmp_path / "a.npz", x=array)
    good = (tmp_path / "a.npz").read_bytes()
    start = good.index(array.tobytes())
    for place in range(start, start + array.size, 97):
        data = bytearray(good)
        data[place] ^= 16
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(InputError, match="Bad CRC"):
            read_arrays(tmp_path / "a.npz")


def test_archives_hold_arrays_only_and_each_once(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("notes.txt", "not an array")
    with pytest.raises(InputError, match=r"'notes\.txt' is no array"):
        read_arrays(tmp_path / "a.npz")


def test_an_archive_that_unpacks_beyond_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(50_000_000, np.uint8))
    assert (tmp_path / "a.npz").stat().st_size < 100_000
    monkeypatch.setattr(memory, "available_bytes", lambda: 40_000_000)
    with pytest.raises(InputError, match="needs about 50 MB of memory, and 40 MB are free"):
        read_arrays(tmp_path / "a.npz")


UNBOUNDED = re.compile(
    r"(json|tomllib|pickle|marshal|shelve|yaml)\.loads?|(np|numpy|torch|joblib)\.load|tomllib\.\w+|pickle\.\w+"
)
"""Readers without limits on size, depth and digits, or that execute what they read."""


def test_no_other_module_parses_json_toml_or_arrays() -> None:
    paths = sorted({*SOURCES.rglob("*.py")} - {Path(tables.__file__), Path(arrays.__file__)})
    assert len(paths) > 500
    found = []
    for path in paths:
        nodes = list(ast.walk(ast.parse(path.read_text())))
        attributes = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
        uses = {ast.unparse(node) for node in attributes}
        uses |= {f"{node.module}.{name.name}" for node in nodes if isinstance(node, ast.ImportFrom) for name in node.names}
        found += [f"{path.relative_to(SOURCES)}: {use}" for use in uses if UNBOUNDED.fullmatch(use)]
    assert not found
