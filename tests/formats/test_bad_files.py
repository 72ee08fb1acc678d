"""Files that cannot be used get a sentence each, and a million Gaussians on one point are no problem."""

import gzip
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussian_files import camera_at, cloud, picture_of

from invgraphics.core import Gaussians
from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, read_gaussians, write_gaussians

LEGACY = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20)


def _ply(folder: Path, gaussians: Gaussians | None = None) -> bytes:
    write_gaussians(folder / "good.ply", "ply", Splats(gaussians or cloud(10, 1)))
    return (folder / "good.ply").read_bytes()


def _spz(folder: Path) -> bytes:
    write_gaussians(folder / "good.spz", "spz", Splats(cloud(10, 1), "RUB"))
    return (folder / "good.spz").read_bytes()


def _empty_ply(folder: Path) -> bytes:
    return _ply(folder).replace(b"vertex 10", b"vertex 0").partition(b"end_header\n")[0] + b"end_header\n"


def _with_nan(folder: Path) -> bytes:
    data = bytearray(_ply(folder))
    at = data.index(b"end_header\n") + len(b"end_header\n")
    data[at : at + 4] = struct.pack("<f", float("nan"))
    return bytes(data)


def _claiming(data: bytes, count: int) -> bytes:
    """An SPZ file whose header names another number of Gaussians."""
    return data[:8] + struct.pack("<I", count) + data[12:]


def _zstd_bomb(count: int) -> bytes:
    """A well-formed SPZ file of zeros: each stream is 4 bytes for 128 KB."""
    block, rest = struct.pack("<I", 1 << 17 << 3 | 2)[:3] + b"\0", struct.pack("<I", (1 << 17) << 3 | 3)[:3] + b"\0"
    streams = []
    for width in (9, 1, 3, 3, 4):
        blocks = -(-count * width // (1 << 17))
        streams.append((b"\x28\xb5\x2f\xfd\x00\x58" + block * (blocks - 1) + rest, blocks << 17))
    head = struct.pack("<4sIIBBBB", b"NGSP", 4, count, 0, 12, 0, len(streams)) + struct.pack("<I12x", 32)
    return head + b"".join(struct.pack("<QQ", len(small), large) for small, large in streams) + b"".join(s for s, _ in streams)


BAD: dict[str, tuple[str, Callable[[Path], bytes], str]] = {
    "cut PLY": ("a.ply", lambda folder: _ply(folder)[:-100], "cut off: .* bytes are expected"),
    "cut header": ("a.ply", lambda folder: _ply(folder)[:100], "header has no end"),
    "wrong names": ("a.ply", lambda folder: _ply(folder).replace(b"f_dc_1", b"green1"), "lack f_dc_1"),
    "points only": (
        "a.ply",
        lambda _: b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n",
        "lack y, z",
    ),
    "no vertices": ("a.ply", lambda _: b"ply\nformat binary_little_endian 1.0\nend_header\n", "lack x, y, z"),
    "ASCII": ("a.ply", lambda folder: _ply(folder).replace(b"binary_little_endian", b"ascii"), "'format ascii 1.0'"),
    "no format": ("a.ply", lambda folder: _ply(folder).replace(b"format", b"comment"), "names no format"),
    "unknown type": ("a.ply", lambda folder: _ply(folder).replace(b"float x", b"quad x"), "'property quad x'"),
    "doubled name": ("a.ply", lambda folder: _ply(folder).replace(b"float nx", b"float x"), "header is broken"),
    "odd degree": ("a.ply", lambda folder: _ply(folder).replace(b"f_rest_8", b"f_misc_8"), "8 properties f_rest"),
    "absurd count": ("a.ply", lambda folder: _ply(folder).replace(b"vertex 10", b"vertex 99999999999999"), "cut off"),
    "no Gaussians": ("a.ply", _empty_ply, "there are no Gaussians"),
    "NaN centre": ("a.ply", _with_nan, "centres of 1 of 10 Gaussians are not finite"),
    "empty": ("a.ply", lambda _: b"", "no file of 3D Gaussians"),
    "picture": ("a.png", lambda _: b"\x89PNG\r\n\x1a\n", "no file of 3D Gaussians"),
    "cut splat": ("a.splat", lambda _: bytes(63), "63 bytes are no multiple of 32"),
    "empty splat": ("a.splat", lambda _: b"", "there are no Gaussians"),
    "no splat": ("a.splat", lambda _: struct.pack("<6f8B", *[-1.0] * 6, *[9] * 8), "scales are negative"),
    "infinite splat": ("a.splat", lambda _: struct.pack("<6f8B", *[float("inf")] * 6, *[9] * 8), "centres of 1 of 1"),
    "wrong magic": ("a.spz", lambda folder: b"NGXP" + _spz(folder)[4:], "no file of 3D Gaussians"),
    "wrong magic in gzip": ("a.spz", lambda _: gzip.compress(b"PK" + LEGACY[2:]), "begins with b'PKSP'"),
    "future version": ("a.spz", lambda folder: _spz(folder)[:4] + b"\x09" + _spz(folder)[5:], "version 9"),
    "cut SPZ": ("a.spz", lambda folder: _spz(folder)[:-5], "cut off"),
    "cut contents": ("a.spz", lambda folder: _spz(folder)[:50], "cut off"),
    "cut head": ("a.spz", lambda folder: _spz(folder)[:10], "cut off"),
    "damaged stream": ("a.spz", lambda folder: _spz(folder)[:-40] + bytes(40), "cannot be decompressed|damaged"),
    "wrong count": ("a.spz", lambda folder: _spz(folder)[:8] + b"\x0b" + _spz(folder)[9:], "do not hold 11 Gaussians"),
    "absurd SPZ degree": ("a.spz", lambda folder: _spz(folder)[:12] + b"\x0b" + _spz(folder)[13:], "SH degree 11"),
    "no SPZ Gaussians": ("a.spz", lambda _: gzip.compress(LEGACY[:8] + bytes(4) + LEGACY[12:16]), "there are no Gaussians"),
    "cut gzip": ("a.spz", lambda _: gzip.compress(LEGACY)[:-12], "is cut off"),
    "damaged gzip": (
        "a.spz",
        lambda _: gzip.compress(LEGACY)[:12] + b"\xff\xff" + gzip.compress(LEGACY)[14:],
        "cannot be decompressed",
    ),
    "cut legacy": ("a.spz", lambda _: gzip.compress(LEGACY[:-4]), "cut off: 36 bytes are expected, 32 are there"),
    "gzip bomb": ("a.spz", lambda _: gzip.compress(LEGACY + bytes(50_000_000)), "continues after its Gaussians"),
    "gzip claim": ("a.spz", lambda _: gzip.compress(_claiming(LEGACY, 2_000_000_000) + bytes(1000)), "claims 2,000,000,000"),
    "zstd claim": ("a.spz", lambda _: _zstd_bomb(60_000_000), "claims 60,000,000 Gaussians"),
    "count of 5000 digits": (
        "a.ply",
        lambda folder: re.sub(rb"element vertex \d+", b"element vertex " + b"9" * 5000, _ply(folder)),
        "PLY header cannot be used",
    ),
    "half a packed PLY": (
        "a.ply",
        lambda folder: _ply(folder).replace(b"float nx", b"float packed_color"),
        "no compressed PLY",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_one_sentence(tmp_path: Path, name: str) -> None:
    file, make, sentence = BAD[name]
    (tmp_path / file).write_bytes(make(tmp_path))
    with pytest.raises(InputError, match=sentence) as caught:
        read_gaussians(tmp_path / file)
    assert file in caught.value.sentence and len(str(caught.value).splitlines()) <= 2


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="There is no file"):
        read_gaussians(tmp_path / "none.ply")
    with pytest.raises(InputError, match="is not a file"):
        read_gaussians(tmp_path)


@pytest.mark.parametrize("what", ["means", "scales", "opacities", "sh", "quaternions"])
def test_nothing_is_written_that_could_not_be_read(tmp_path: Path, what: str) -> None:
    gaussians = cloud(5, 0)
    broken = getattr(gaussians, what).clone()
    broken[2] = torch.nan
    with pytest.raises(InputError, match="of 1 of 5 Gaussians are not finite"):
        write_gaussians(tmp_path / "a.ply", "ply", Splats(replace(gaussians, **{what: broken})))
    with pytest.raises(InputError, match="there are no Gaussians"):
        write_gaussians(tmp_path / "a.ply", "ply", Splats(cloud(0, 0)))
    with pytest.raises(InputError, match="no 'obj' among the formats"):
        write_gaussians(tmp_path / "a.obj", "obj", Splats(gaussians))
    assert not list(tmp_path.iterdir())


def test_a_million_gaussians_on_one_point(tmp_path: Path) -> None:
    table = np.zeros(1_000_000, [("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])
    table["scale"], table["rgba"], table["turn"] = 0.05, [255, 0, 0, 3], [255, 128, 128, 128]
    (tmp_path / "a.splat").write_bytes(table.tobytes())
    gaussians = read_gaussians(tmp_path / "a.splat")[1].gaussians
    for name in ("ply", "spz"):
        write_gaussians(tmp_path / f"b.{name}", name, Splats(gaussians))
        back = read_gaussians(tmp_path / f"b.{name}")[1].gaussians
        assert len(back) == 1_000_000 and not bool(back.means.any())
    picture = picture_of(gaussians, camera_at([3.0, 0.0, 0.0], [0.0, 0.0, 1.0], size=16))
    assert torch.allclose(picture[8, 8], torch.tensor([1.0, 0.0, 0.0]), atol=0.01)
