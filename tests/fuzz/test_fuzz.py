"""Damaged inputs of every reader: refused in one sentence, or read and right; nothing else.

``INVGRAPHICS_FUZZ`` is the number of mutations per reader, of a seed that changes with the day (YYYYMMDD), which
``INVGRAPHICS_FUZZ_SEED`` repeats. Without it, as in the test suite, few of one seed are made.
"""

from __future__ import annotations

import datetime
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("hypothesis")
pytest.importorskip("resource", reason="limits of memory are POSIX's")

import mutations
import seeds
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from watched import Process, Reader

COUNT = int(os.environ.get("INVGRAPHICS_FUZZ", "60"))
TODAY = f"{datetime.datetime.now(datetime.UTC):%Y%m%d}" if "INVGRAPHICS_FUZZ" in os.environ else "20261130"
SEED = int(os.environ.get("INVGRAPHICS_FUZZ_SEED", TODAY))
PAGE_SHARE = 20
"""A page takes as long as this many readings, so that as many times fewer are made."""
CHECKED = {("images", "*"), ("npz", "flip"), ("idr", "flip"), ("old_spz", "flip")}
"""Readers of files with checksums, and mutations: what is accepted after them reads as if nothing had happened."""

WHOLE = {"idr", "llff", "npz", "ply", "compressed_ply", "spz", "old_spz", "colmap_binary", "checkpoint", "images"}
"""Readers of files that say how long they are: of none is a beginning accepted."""


class Drawn:
    """Decisions that Hypothesis makes and shrinks."""

    def __init__(self, data: st.DataObject) -> None:
        self._data = data

    def index(self, count: int) -> int:
        """One of 0 .. count - 1."""
        return self._data.draw(st.integers(0, max(count - 1, 0)))


def kind_of(name: str) -> str:
    """Which reader reads a seed."""
    if name in seeds.FOLDERS:
        return seeds.FOLDERS[name][0]
    if name in ("recipe", "study"):
        return name
    return "gaussians" if name in {make.__name__ for make in seeds.GAUSSIANS} else "scene"


def spec_of(root: Path, pattern: str, name: str) -> Path:
    """What a person would name: the folder of a scene, or the file."""
    folder = name in seeds.FOLDERS and name not in ("checkpoint", "description", "camera_path")
    return root if folder or (kind_of(name) == "scene" and name != "npz") else root / pattern


@pytest.fixture(scope="module")
def process() -> Iterator[Process]:
    """The process that reads all inputs."""
    started = Process()
    yield started
    started.close()


@pytest.fixture(scope="module", params=list(seeds.SEEDS))
def good(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, process: Process
) -> tuple[str, Path, str, Reader]:
    """Name, folder and pattern of a good input, and what reads its copies."""
    root = tmp_path_factory.mktemp(request.param) / "good"
    root.mkdir()
    pattern = seeds.SEEDS[request.param](root)
    reader = Reader(process, kind_of(request.param), spec_of(root, pattern, request.param))
    return request.param, root, pattern, reader


def expect_fine(reader: Reader, path: Path, what: str, unchanged: bool) -> str:
    """Refused in one sentence (and at most a line of remedy), or accepted and right; returns which."""
    outcome, answer = reader.read(path)
    if outcome == "refused":
        assert len(answer.splitlines()) <= 2 and len(answer) < 2000, f"{what}: not one sentence: {answer}"
    else:
        assert outcome == "accepted", f"{what}: {outcome}: {answer}"
        assert not unchanged or answer == reader.digest, f"{what}: accepted, and read as something else"
    return outcome


@pytest.mark.timeout(3600)
def test_damaged_inputs_are_refused_or_right(good: tuple[str, Path, str, Reader]) -> None:
    name, root, pattern, reader = good
    print(f"INVGRAPHICS_FUZZ_SEED={SEED} INVGRAPHICS_FUZZ={COUNT}")
    bad = root.with_name("bad")
    shutil.copytree(root, bad)
    files = sorted(bad.glob(pattern))
    outcomes: Counter[str] = Counter()

    @seed(SEED)
    @settings(
        max_examples=max(10, COUNT // PAGE_SHARE) if name.startswith("report") else COUNT,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(st.data())
    def search(data: st.DataObject) -> None:
        choose = Drawn(data)
        path = mutations.pick(choose, files)
        before = path.read_bytes()
        try:
            change = mutations.mutate(path, choose)
            what, unchanged = f"{path.name}, {change}", bool({(name, "*"), (name, change)} & CHECKED)
            outcome = expect_fine(reader, spec_of(bad, pattern, name), what, unchanged)
            outcomes[outcome] += 1
        finally:
            path.write_bytes(before)

    search()
    print(f"{name}: {outcomes['refused']} refused, {outcomes['accepted']} accepted")
    assert outcomes["refused"] or name not in WHOLE, "none of the damaged files was refused"


def test_beginnings_of_files_are_refused(good: tuple[str, Path, str, Reader]) -> None:
    name, root, pattern, reader = good
    if name not in WHOLE:
        pytest.skip("a shorter file can be a whole one")
    for path in sorted(root.glob(pattern)):
        data = path.read_bytes()
        try:
            for length in sorted({0, 1, 8, len(data) // 2, len(data) - 1}):
                path.write_bytes(data[:length])
                outcome, answer = reader.read(spec_of(root, pattern, name))
                assert outcome == "refused", f"the first {length} of {len(data)} bytes of {path.name}: {outcome}: {answer}"
        finally:
            path.write_bytes(data)


def test_harmless_changes_are_accepted_as_the_same(good: tuple[str, Path, str, Reader]) -> None:
    """File by file; all at once where a page is written, which takes as long as many readings."""
    name, root, pattern, reader = good
    files = sorted(root.glob("truth.json" if name == "rendered" else pattern))  # the truth lists the sizes of its files
    for changed in [files] if name.startswith("report") else [[path] for path in files]:
        before = {path: path.read_bytes() for path in changed}
        try:
            ways = [mutations.harmless(path) for path in changed]
            if any(ways):
                assert reader.read(spec_of(root, pattern, name)) == ("accepted", reader.digest)
        finally:
            for path, content in before.items():
                path.write_bytes(content)
