"""COLMAP's binary files cut anywhere: a sentence at once, where COLMAP itself reads on for ever."""

import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap
import pytest
from test_colmap_loader import mixed

from invgraphics.errors import InputError
from invgraphics.scenes.colmap import Colmap
from invgraphics.scenes.colmap_sizes import check_sizes
from invgraphics.scenes.colmap_workspace import find_model
from invgraphics.scenes.layout import SceneOptions

FILES = ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Nine photographs and their model as COLMAP itself writes it in binary, observations included."""
    root = mixed(tmp_path / "scene")
    folder = root / "sparse" / "0"
    images = (folder / "images.txt").read_text().split("\n")[::2]
    seen = [f"{line}\n1.5 2.5 {index % 6 + 1} 3.5 4.5 -1\n" for index, line in enumerate(images) if line]
    (folder / "images.txt").write_text("".join(seen))
    points = (folder / "points3D.txt").read_text().splitlines()
    tracks = ["".join(f" {image + 1} 0" for image in range(index, 9, 6)) for index in range(6)]
    (folder / "points3D.txt").write_text("\n".join(map(str.__add__, points, tracks)) + "\n")
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for text in folder.glob("*.txt"):
        text.unlink()
    return folder


@contextmanager
def soon(seconds: float = 5.0) -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_what_colmap_writes_is_walked_to_its_end(model: Path) -> None:
    assert sorted(path.name for path in model.iterdir()) == sorted(FILES)
    check_sizes(model)
    assert len(Colmap().load(model.parents[1], SceneOptions()).train) == 7


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("left", [0, 5, 8, 0.3, 0.9, -1])
def test_cut_files_are_refused_at_once(model: Path, name: str, left: float) -> None:
    data = (model / name).read_bytes()
    keep = int(left * len(data)) if isinstance(left, float) else left % (len(data) + 1) if left >= 0 else len(data) + left
    (model / name).write_bytes(data[:keep])
    with soon(), pytest.raises(InputError, match=rf"{name} is cut off: it has {keep:,} bytes"):
        find_model(model.parents[1])


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [2**64 - 1, 2**40])
def test_absurd_counts_are_refused_at_once(model: Path, name: str, count: int) -> None:
    data = (model / name).read_bytes()
    (model / name).write_bytes(struct.pack("<Q", count) + data[8:])
    with soon(), pytest.raises(InputError, match="is cut off"):
        find_model(model.parents[1])


def test_what_a_smaller_count_would_drop_is_noticed(model: Path) -> None:
    data = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(struct.pack("<Q", 8) + data[8:])
    with pytest.raises(InputError, match=r"bytes more than its 8 entries take"):
        find_model(model.parents[1])


def test_rigs_with_poses_are_walked(tmp_path: Path) -> None:
    """Rig 1: a reference, a sensor with a pose and one without; rig 2 is empty."""
    sensor = struct.pack("<iI", 0, 1)
    rigs = struct.pack("<QII", 2, 1, 3) + sensor + sensor + b"\1" + bytes(56) + sensor + b"\0" + struct.pack("<II", 2, 0)
    (tmp_path / "rigs.bin").write_bytes(rigs)
    check_sizes(tmp_path)
    (tmp_path / "rigs.bin").write_bytes(rigs[:-3])
    with pytest.raises(InputError, match="entry 2 of 2 is not whole"):
        check_sizes(tmp_path)


@pytest.mark.data
@pytest.mark.parametrize("name", ["colmap_beer/sparse/0", "colmap_statue/dense/0/sparse"])
def test_real_models_are_walked_to_their_ends(data, name: str) -> None:
    check_sizes(data(name))
