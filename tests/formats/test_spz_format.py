"""SPZ against files that the format's authors' own library (nianticlabs/spz, C++) wrote."""

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import torch
from gaussian_files import cloud, worst_psnr

from invgraphics.core import Gaussians
from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, read_gaussians, write_gaussians
from invgraphics.formats.spz_attributes import fraction_bits, pack

# Three Gaussians of SH degree 1, flag "antialiased", written with PackOptions{version, from = RUB} and 12 fraction bits.
WRITTEN = {
    2: "1f8b0800000000000003f3730f0e60626060600662461e4606060e068637ff191418182efc67004a7cf9cfe0c0c6d0f0"
    "99e18050c343fd65919d0d93733ef19e69284898b0c2a1a2a2a23775f9bba294fdfb1d1ebc98a0219070e1c306070187"
    "0d1f4e2408684c78f1a04141a2e0c607000e85ed4264000000",
    3: "1f8b080000000000000301670098ff4e4753500300000003000000010c010000080000ecff00200000d0ff00020000f4"
    "ff0040060080f300c01280e12fa6598980936cf20dcc80706090a840787878de50aac43a75ea2469a59d16e0e8902810"
    "60d0f0b0401040b0f0c860102890e8e080201870d8f00104e6ef67000000",
    4: "4e4753500400000003000000010c01062000000000000000000000000000000024000000000000001b00000000000000"
    "0c0000000000000003000000000000001200000000000000090000000000000012000000000000000900000000000000"
    "15000000000000000c0000000000000024000000000000001b0000000000000028b52ffd201bd9000000080000ecff00"
    "200000d0ff00020000f4ff0040060080f300c01228b52ffd200319000080e12f28b52ffd2009490000a6598980936cf2"
    "0dcc28b52ffd200949000080706090a84078787828b52ffd200c610000de50aac43a75ea2469a59d1628b52ffd201bd9"
    "0000e0e890281060d0f0b0401040b0f0c860102890e8e080201870d8f0",
}


def original() -> Gaussians:
    """What went into those files."""
    xyzw = torch.tensor([[0.1, -0.2, 0.3, 0.9], [-0.8, 0.1, 0.2, -0.4], [0.5, 0.5, -0.5, 0.5]])
    dc = torch.tensor([[1.0, -1.0, 0.25], [0.0, 0.5, -0.5], [3.0, -3.0, 2.0]])
    rest = 0.9 * torch.sin(1.0 + torch.arange(27)).view(3, 3, 3)
    return Gaussians(
        means=torch.tensor([[0.5, -1.25, 2.0], [-3.0, 0.125, -0.75], [100.0, -200.0, 300.0]]),
        quaternions=xyzw.roll(1, dims=1),
        scales=torch.tensor([[-2.0, -3.0, -4.0], [-1.0, 0.5, -6.0], [-2.5, -2.5, -2.5]]).exp(),
        opacities=torch.sigmoid(torch.tensor([0.0, 2.0, -1.5])),
        sh=torch.cat([dc[:, None], rest], dim=1),
    )


def assert_alike(read: Gaussians, rotation: float) -> None:
    """Equal up to the format's steps."""
    true = original()
    assert torch.equal(read.means, true.means)  # multiples of 2^-12 all
    turn = torch.nn.functional.normalize(true.quaternions, dim=1)
    assert (read.quaternions * turn).sum(dim=1).abs().min() > 1 - rotation
    assert torch.allclose(read.scales.log(), true.scales.log(), atol=1 / 32)
    assert torch.allclose(read.opacities, true.opacities, atol=0.5 / 255)
    assert torch.allclose(read.sh[:, 0], true.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-6)
    assert torch.allclose(read.sh[:, 1:], true.sh[:, 1:], atol=4.5 / 128)


@pytest.mark.parametrize("version", WRITTEN)
def test_files_of_the_authors_library(tmp_path: Path, version: int) -> None:
    (tmp_path / "a.spz").write_bytes(bytes.fromhex(WRITTEN[version]))
    name, splats = read_gaussians(tmp_path / "a.spz")
    assert (name, splats.axes, splats.antialiased) == ("spz", "RUB", True)
    assert_alike(splats.gaussians, rotation=1e-4 if version == 2 else 1e-5)


def test_version_1_has_half_floats_for_positions(tmp_path: Path) -> None:
    positions = np.array([[0.5, -1.25, 2.0], [-3.0, 0.125, -0.75]], "<f2").tobytes()
    rest = bytes([255, 0, *[128] * 6, *[160] * 6, *[128, 128, 255, 0, 128, 128]])
    (tmp_path / "a.spz").write_bytes(struct.pack("<4sIIBBBB", b"NGSP", 1, 2, 0, 0, 0, 0) + positions + rest)
    gaussians = read_gaussians(tmp_path / "a.spz")[1].gaussians
    assert torch.equal(gaussians.means, original().means[:2])
    assert gaussians.opacities.tolist() == [1.0, 0.0]
    assert torch.allclose(gaussians.scales, torch.ones(2, 3))
    assert torch.allclose(gaussians.quaternions, torch.tensor([[0.0, 0, 0, 1], [0.0, -1, 0, 0]]), atol=0.01)


def test_our_bytes_are_those_of_the_authors_library() -> None:
    data = bytes.fromhex(WRITTEN[4])
    entries = [struct.unpack_from("<QQ", data, 32 + 16 * i) for i in range(6)]
    start, ours = 32 + 96, pack(original(), fraction=12)
    for (small, large), (name, values) in zip(entries, ours.items(), strict=True):
        theirs = pyarrow.Codec("zstd").decompress(data[start : start + small], large, asbytes=True)
        assert values.tobytes() == theirs, name
        start += small


@pytest.mark.parametrize(("degree", "bound"), [(0, 55), (1, 45), (2, 37), (3, 33)])  # measured: 57.3, 47.7, 39.6, 35.7 dB
def test_what_is_read_back_looks_alike(tmp_path: Path, degree: int, bound: float) -> None:
    """The upper bands lose most, which keep 5 and 4 bits; these clouds change their colours with direction a lot."""
    gaussians = cloud(degree=degree)
    write_gaussians(tmp_path / "a.spz", "spz", Splats(gaussians, "RUB", antialiased=True))
    name, back = read_gaussians(tmp_path / "a.spz")
    assert (name, back.axes, back.antialiased) == ("spz", "RUB", True)
    assert back.gaussians.sh.shape == gaussians.sh.shape
    assert worst_psnr(gaussians, back.gaussians) > bound


@pytest.mark.parametrize("farthest", [1e-3, 1.0, 3e3, 8e6])
def test_positions_get_the_resolution_they_leave_room_for(tmp_path: Path, farthest: float) -> None:
    gaussians = cloud(50, 0)
    gaussians = replace(gaussians, means=gaussians.means / gaussians.means.abs().max() * farthest)
    write_gaussians(tmp_path / "a.spz", "spz", Splats(gaussians, "RUB"))
    back = read_gaussians(tmp_path / "a.spz")[1].gaussians
    assert float((back.means - gaussians.means).abs().max()) <= max(farthest * 2**-22, 2**-21)


def test_what_is_too_far_away_is_refused() -> None:
    with pytest.raises(InputError, match=r"1e\+07 units from the origin"):
        fraction_bits(torch.full((1, 3), 1e7))


def test_an_extension_can_name_other_axes(tmp_path: Path) -> None:
    """An unknown extension of 3 bytes, then Adobe's with the code of RDF, both before the table of contents."""
    data = bytes.fromhex(WRITTEN[4])
    records = struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", 0xADBE0003, 4, 6)
    head = bytearray(data[:32])
    head[14] |= 2
    head[16:20] = struct.pack("<I", 32 + len(records))
    (tmp_path / "a.spz").write_bytes(bytes(head) + records + data[32:])
    splats = read_gaussians(tmp_path / "a.spz")[1]
    assert splats.axes == "RDF"
    assert_alike(splats.gaussians, rotation=1e-5)


def test_a_fifth_band_is_left_out(tmp_path: Path) -> None:
    rest = bytes(range(72))
    body = bytes(9) + bytes([128] * 4) + bytes(3) + bytes([0, 0, 0, 192]) + rest
    (tmp_path / "a.spz").write_bytes(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 4, 12, 0, 0) + body)
    splats = read_gaussians(tmp_path / "a.spz")[1]
    assert splats.gaussians.sh.shape == (1, 16, 3)
    assert torch.allclose(splats.gaussians.sh[0, 1:].flatten(), (torch.arange(45.0) - 128) / 128)
    assert any("degree 4" in note for note in splats.notes)


def test_version_3_is_what_the_authors_library_writes(tmp_path: Path) -> None:
    """Byte by byte once decompressed, but for the number of fraction bits, which ours chooses."""
    write_gaussians(tmp_path / "a.spz", "spz", Splats(original(), "RUB", antialiased=True), version=3)
    assert_alike(read_gaussians(tmp_path / "a.spz")[1].gaussians, rotation=1e-5)
    ours, theirs = (gzip.decompress(data) for data in ((tmp_path / "a.spz").read_bytes(), bytes.fromhex(WRITTEN[3])))
    head, known = struct.unpack_from("<4sIIBBBB", ours), struct.unpack_from("<4sIIBBBB", theirs)
    assert head[:4] == known[:4] and head[5] == known[5] == 1
    positions = 16 + 9 * len(original())
    assert len(ours) == len(theirs) and ours[positions:] == theirs[positions:]
