"""3DGS's PLY against plyfile, a reader and writer of other authors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussian_files import cloud, worst_psnr
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement

from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, read_gaussians, write_gaussians

STANDARD = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


@pytest.mark.parametrize("degree", range(4))
def test_an_independent_reader_finds_the_standard_properties(tmp_path: Path, degree: int) -> None:
    gaussians = cloud(20, degree)
    write_gaussians(tmp_path / "a.ply", "ply", Splats(gaussians, notes=("made here",)))
    content = PlyData.read(tmp_path / "a.ply")
    vertex = content["vertex"]
    rest = 3 * ((degree + 1) ** 2 - 1)
    expected = [name for name in STANDARD if not name.startswith("f_rest_") or int(name[7:]) < rest]
    assert [(one.name, one.val_dtype) for one in vertex.properties] == [(name, "f4") for name in expected]
    assert not content.text and content.byte_order == "<" and content.comments == ["made here"]
    assert vertex.data.itemsize == (62 if degree == 3 else len(expected)) * 4
    assert np.array_equal(vertex["x"], gaussians.means[:, 0])
    assert np.allclose(1 / (1 + np.exp(-vertex["opacity"])), gaussians.opacities, atol=1e-6)
    assert np.allclose(np.exp(vertex["scale_1"]), gaussians.scales[:, 1], rtol=1e-6)
    assert not vertex["nx"].any()
    for k, channel in (
        (k, c) for k in range(1, (degree + 1) ** 2) for c in range(3)
    ):  # first all of red, then green, then blue
        assert np.array_equal(vertex[f"f_rest_{channel * rest // 3 + k - 1}"], gaussians.sh[:, k, channel])
    turn = np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1)
    assert np.allclose(turn, torch.nn.functional.normalize(gaussians.quaternions), atol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_what_is_read_back_looks_the_same(tmp_path: Path, degree: int) -> None:
    gaussians = cloud(degree=degree)
    write_gaussians(tmp_path / "a.ply", "ply", Splats(gaussians))
    name, back = read_gaussians(tmp_path / "a.ply")
    assert name == "ply" and back.axes is None and back.gaussians.sh.shape == gaussians.sh.shape
    assert worst_psnr(gaussians, back.gaussians) > 100


def test_another_ending_is_refused(tmp_path: Path) -> None:
    """Programs that go by it would not read the file, and a run's own files have other endings."""
    for name, file in (("ply", "a.splat"), ("spz", "a.PLY"), ("splat", "a.compressed.ply"), ("ply", "checkpoint.safetensors")):
        with pytest.raises(InputError, match=f"has another ending than {name} files"):
            write_gaussians(tmp_path / file, name, Splats(cloud(degree=0)))
    assert not list(tmp_path.iterdir())


def _table(names: list[str], kind: str, n: int = 5) -> np.ndarray:
    table = np.zeros(n, [(name, kind) for name in names])
    for i, name in enumerate(names):
        table[name] = np.linspace(-1, 1, n) + 0.1 * i
    return table


@pytest.mark.parametrize(("kind", "order"), [("f4", "<"), ("f8", "<"), ("f4", ">")])
def test_files_of_an_independent_writer(tmp_path: Path, kind: str, order: str) -> None:
    """Other properties in other places, double precision, big-endian, elements before and after, no normals."""
    names = ["red", *(name for name in reversed(STANDARD) if name not in ("nx", "ny", "nz")), "confidence"]
    table = _table(names, kind)
    other = np.array([(1, 2)], [("width", "i4"), ("height", "i4")])
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(one, name) for one, name in ((other, "size"), (table, "vertex"), (faces, "face"))]
    PlyData(elements, byte_order=order).write(tmp_path / "a.ply")
    gaussians = read_gaussians(tmp_path / "a.ply")[1].gaussians
    assert torch.allclose(gaussians.means[:, 1], torch.from_numpy(table["y"].astype(np.float32)))
    assert torch.allclose(gaussians.opacities, 1 / (1 + torch.exp(-torch.from_numpy(table["opacity"].astype(np.float32)))))
    assert torch.allclose(gaussians.quaternions[:, 3], torch.from_numpy(table["rot_3"].astype(np.float32)))
    assert torch.allclose(gaussians.sh[:, 4, 1], torch.from_numpy(table["f_rest_18"].astype(np.float32)))


def test_a_stored_3d_filter_is_applied(tmp_path: Path) -> None:
    """As Mip-Splatting's training code writes them: a blurred Gaussian is wider, lower, and has the same integral."""
    names = [name for name in STANDARD if not name.startswith("f_rest_")]
    table = _table([*names, "filter_3D"], "f4")
    PlyData([PlyElement.describe(repack_fields(table[names]), "vertex")]).write(tmp_path / "bare.ply")
    table["filter_3D"] = np.array([0.0, 0.1, 0.5, 1.0, 3.0])
    PlyData([PlyElement.describe(table, "vertex")]).write(tmp_path / "filtered.ply")
    bare, filtered = (read_gaussians(tmp_path / f"{name}.ply")[1] for name in ("bare", "filtered"))
    assert any("filter_3D" in note for note in filtered.notes) and not bare.notes
    assert (filtered.antialiased, bare.antialiased) == (True, None)  # its 2D filter keeps the integral, too
    bare, filtered = bare.gaussians, filtered.gaussians
    variance = bare.scales**2 + torch.from_numpy(table["filter_3D"].copy())[:, None] ** 2
    torch.testing.assert_close(filtered.scales**2, variance)
    mass, filtered_mass = (one.opacities * one.scales.prod(dim=1) for one in (bare, filtered))
    torch.testing.assert_close(filtered_mass, mass)


@pytest.mark.parametrize("flushed", [False, True])
def test_extreme_opacities_and_scales_stay_finite(tmp_path: Path, flushed: bool) -> None:
    """Also in a process that has fitted, which flushes denormals to zero."""
    gaussians = cloud(3, 0)
    gaussians = replace(gaussians, opacities=torch.tensor([0.0, 1.0, 0.5]), scales=torch.zeros(3, 3))
    torch.set_flush_denormal(flushed)
    try:
        write_gaussians(tmp_path / "a.ply", "ply", Splats(gaussians))
    finally:
        torch.set_flush_denormal(False)
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    assert np.isfinite(vertex["opacity"]).all() and np.isfinite(vertex["scale_0"]).all()
    back = read_gaussians(tmp_path / "a.ply")[1].gaussians
    assert torch.allclose(back.opacities, gaussians.opacities, atol=1e-6)


def test_infinite_logits_of_other_writers_are_opacities_of_one(tmp_path: Path) -> None:
    table = _table([name for name in STANDARD if not name.startswith("f_rest_")], "f4")
    table["opacity"] = np.inf
    PlyData([PlyElement.describe(table, "vertex")]).write(tmp_path / "a.ply")
    assert bool((read_gaussians(tmp_path / "a.ply")[1].gaussians.opacities == 1).all())
