"""PlayCanvas's compressed PLY against integers packed one at a time, written by plyfile."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, read_gaussians, write_gaussians

ENDS = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLOUR_ENDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]


def _pack(values: list[float], bits: list[int]) -> int:
    word = 0
    for value, width in zip(values, bits, strict=True):
        word = (word << width) | round(value * ((1 << width) - 1))
    return word


def _write(path: Path, n: int = 300, colour_ranges: bool = True, sh: int = 0) -> np.ndarray:
    """A file of ``n`` Gaussians; returns the rotations (w, x, y, z) that it should hold."""
    chunks = np.zeros(math.ceil(n / 256), [(name, "f4") for name in (ENDS + COLOUR_ENDS if colour_ranges else ENDS)])
    for i, name in enumerate(chunks.dtype.names):
        chunks[name] = (i + np.arange(len(chunks))) * (1 if name.startswith("max") else -0.5)
    turns = np.random.default_rng(0).normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    vertices = np.zeros(n, [(f"packed_{what}", "u4") for what in ("position", "rotation", "scale", "color")])
    for row, turn in zip(vertices, turns, strict=True):
        largest = int(np.abs(turn).argmax())
        others = np.delete(turn, largest) * np.sign(turn[largest])
        row["packed_rotation"] = largest << 30 | _pack(list(others / math.sqrt(2) + 0.5), [10, 10, 10])
        row["packed_position"] = _pack([0.25, 0.5, 1.0], [11, 10, 11])
        row["packed_scale"] = _pack([0.0, 1.0, 0.75], [11, 10, 11])
        row["packed_color"] = _pack([0.2, 0.4, 0.6, 0.8], [8, 8, 8, 8])
    elements = [PlyElement.describe(chunks, "chunk"), PlyElement.describe(vertices, "vertex")]
    if sh:
        stored = np.zeros(n, [(f"f_rest_{i}", "u1") for i in range(sh)])
        for i in range(sh):
            stored[f"f_rest_{i}"] = [0, 255, 128, 10][i % 4]
        elements.append(PlyElement.describe(stored, "sh"))
    PlyData(elements).write(path)
    return turns


@pytest.mark.parametrize("colour_ranges", [True, False])
def test_integers_mean_what_the_format_says(tmp_path: Path, colour_ranges: bool) -> None:
    turns = _write(tmp_path / "a.ply", colour_ranges=colour_ranges)
    name, splats = read_gaussians(tmp_path / "a.ply")
    gaussians = splats.gaussians
    assert name == "compressed-ply" and splats.axes is None

    def value(end: int, chunk: int, share: float) -> float:
        return -0.5 * (end + chunk) * (1 - share) + (end + 3 + chunk) * share

    for row, chunk in ((0, 0), (299, 1)):
        assert gaussians.means[row].tolist() == pytest.approx(
            [value(0, chunk, 0.25), value(1, chunk, 0.5), value(2, chunk, 1)], abs=3e-3
        )
        logs = [value(6, chunk, 0.0), value(7, chunk, 1.0), value(8, chunk, 0.75)]
        assert gaussians.scales[row].log().tolist() == pytest.approx(logs, abs=5e-3)
        shares = [0.2, 0.4, 0.6]
        colours = [value(12 + c, chunk, share) for c, share in enumerate(shares)] if colour_ranges else shares
        assert (0.5 + 0.28209479 * gaussians.sh[row, 0]).tolist() == pytest.approx(colours, abs=0.02)
    assert gaussians.opacities.tolist() == pytest.approx([0.8] * 300)
    agreement = np.abs((gaussians.quaternions.numpy() * turns).sum(axis=1))
    assert agreement.min() > 0.99999


@pytest.mark.parametrize(("floats", "degree"), [(9, 1), (24, 2), (45, 3)])
def test_upper_bands(tmp_path: Path, floats: int, degree: int) -> None:
    _write(tmp_path / "a.ply", sh=floats)
    sh = read_gaussians(tmp_path / "a.ply")[1].gaussians.sh
    assert sh.shape == (300, (degree + 1) ** 2, 3)
    stored = [-4.0, 4.0, 0.5 / 256 * 8, (10.5 / 256 - 0.5) * 8]
    for i in range(floats):
        channel, k = divmod(i, floats // 3)
        assert torch.allclose(sh[:, 1 + k, channel], torch.tensor(stored[i % 4]))


def test_elements_of_too_few_rows_are_refused(tmp_path: Path) -> None:
    _write(tmp_path / "a.ply", sh=9)
    found = PlyData.read(tmp_path / "a.ply")
    for name, words in (("chunk", "300 Gaussians and only 1 chunks of 256"), ("sh", "but the SH coefficients of 299")):
        kept = [
            PlyElement.describe(element.data[:-1] if element.name == name else element.data, element.name) for element in found
        ]
        PlyData(kept).write(tmp_path / "less.ply")
        with pytest.raises(InputError, match=words):
            read_gaussians(tmp_path / "less.ply")


def test_it_is_not_written(tmp_path: Path) -> None:
    _write(tmp_path / "a.ply")
    with pytest.raises(InputError, match="can only be read"):
        write_gaussians(tmp_path / "b.ply", "compressed-ply", Splats(read_gaussians(tmp_path / "a.ply")[1].gaussians))
