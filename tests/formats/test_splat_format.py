"""The 32-byte format against bytes packed one at a time."""

import struct
from pathlib import Path

import pytest
import torch
from gaussian_files import cloud, worst_psnr

from invgraphics.formats.base import Splats, read_gaussians, write_gaussians


def test_bytes_mean_what_the_format_says(tmp_path: Path) -> None:
    record = struct.pack("<3f3f4B4B", 1.0, -2.0, 3.0, 0.1, 0.2, 0.3, 255, 0, 51, 204, 128 + 64, 128, 128, 128 - 64)
    (tmp_path / "a.splat").write_bytes(record)
    name, splats = read_gaussians(tmp_path / "a.splat")
    gaussians = splats.gaussians
    assert name == "splat"
    assert gaussians.means.tolist() == [[1.0, -2.0, 3.0]]
    assert gaussians.scales.tolist()[0] == pytest.approx([0.1, 0.2, 0.3])
    assert gaussians.opacities.item() == pytest.approx(0.8)
    assert (0.5 + 0.28209479 * gaussians.sh[0, 0]).tolist() == pytest.approx([1.0, 0.0, 0.2], abs=1e-6)
    assert gaussians.quaternions.tolist() == [[0.5, 0.0, 0.0, -0.5]]


def test_what_is_read_back_looks_alike(tmp_path: Path) -> None:
    gaussians = cloud(degree=0)
    write_gaussians(tmp_path / "a.splat", "splat", Splats(gaussians))
    assert (tmp_path / "a.splat").stat().st_size == 32 * len(gaussians)
    back = read_gaussians(tmp_path / "a.splat")[1].gaussians
    assert worst_psnr(gaussians, back) > 60  # 65.8 measured; colours within [0, 1]
    size = gaussians.scales.prod(dim=1) * gaussians.opacities
    assert torch.equal(back.means[0], gaussians.means[size.argmax()]), "large and opaque ones come first"
    assert torch.equal(back.means[-1], gaussians.means[size.argmin()])


def test_view_dependence_is_dropped(tmp_path: Path) -> None:
    """What a model of degree 1 loses by that, here: the format keeps its mean colours only."""
    write_gaussians(tmp_path / "a.splat", "splat", Splats(cloud(degree=1)))
    back = read_gaussians(tmp_path / "a.splat")[1].gaussians
    assert back.sh.shape == (400, 1, 3)
    assert 33 < worst_psnr(cloud(degree=1), back) < 38  # 35.1 measured


def test_rotations_of_length_zero_become_none_at_all(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(struct.pack("<6f8B", *[1.0] * 6, *[128] * 8))
    splats = read_gaussians(tmp_path / "a.splat")[1]
    assert splats.gaussians.quaternions.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert splats.notes == ("1 rotations of length zero.",)
