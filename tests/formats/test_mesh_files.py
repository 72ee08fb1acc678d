"""Mesh files: written, and read back by trimesh, plyfile and our reader."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData

from invgraphics.core import Mesh
from invgraphics.core.colour import srgb_to_linear
from invgraphics.errors import InputError
from invgraphics.formats.mesh import SUFFIXES, mesh_from_file, read_mesh, write_mesh
from invgraphics.testing import toy_scene
from invgraphics.tools.file_frames import file_from_local

CORNERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
RGB = torch.tensor([[0.0, 0.02, 0.05], [1.0, 0.5, 0.25], [0.1, 0.9, 0.7], [0.3, 0.3, 0.3]])


@pytest.fixture
def solid() -> Mesh:
    mesh = Mesh(CORNERS, FACES)
    return Mesh(CORNERS, FACES, normals=mesh.outwards())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_written_is_read(solid: Mesh, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"solid{suffix}"
    write_mesh(path, solid, RGB, ("made by a test", "in two lines"))
    back = read_mesh(path)
    torch.testing.assert_close(back.vertices, CORNERS)
    assert torch.equal(back.faces, FACES)
    assert back.rgb is not None
    # GLB holds float colours; the others 8 bits, or eight decimals of those.
    torch.testing.assert_close(back.rgb, RGB, atol=1e-5 if suffix == ".glb" else 0.5 / 255 + 1e-6, rtol=0)
    theirs = trimesh.load_mesh(path, process=False)
    assert theirs.is_watertight
    assert theirs.volume == pytest.approx(1.0)


def test_ply_says_where_it_comes_from(solid: Mesh, tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.ply", solid, RGB, ("one line", "another"))
    file = PlyData.read(tmp_path / "a.ply")
    assert {"one line", "another"} <= set(file.comments)
    stored = np.stack([file["vertex"][axis] for axis in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(stored, solid.normals, atol=1e-6)
    np.testing.assert_allclose(file["vertex"]["green"], 255 * RGB[:, 1], atol=0.51)


def test_glb_has_linear_unlit_colours(solid: Mesh, tmp_path: Path) -> None:
    """Read by hand: JSON chunk, then the accessor of COLOR_0 (glTF 2.0, §3.7.2 and §4.4)."""
    write_mesh(tmp_path / "a.glb", solid, RGB, ("made by a test",))
    data = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + length])
    primitive = tree["meshes"][0]["primitives"][0]
    for name, expected in (("COLOR_0", srgb_to_linear(RGB)), ("NORMAL", solid.normals), ("POSITION", CORNERS)):
        accessor = tree["accessors"][primitive["attributes"][name]]
        assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
        view = tree["bufferViews"][accessor["bufferView"]]
        start = 28 + length + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stored = np.frombuffer(data[start : start + 48], "<f4").reshape(4, 3)
        np.testing.assert_allclose(stored, expected, atol=1e-6)
    material = tree["materials"][primitive["material"]]
    assert "KHR_materials_unlit" in material["extensions"]
    assert "KHR_materials_unlit" in tree["extensionsUsed"]
    assert tree["asset"]["copyright"] == "made by a test"


@pytest.mark.parametrize("world", ["z-up", "opencv", "LUF", "no axes", None])
def test_a_glb_comes_back_from_whatever_world_it_was_turned(solid: Mesh, tmp_path: Path, world: str | None) -> None:
    """By what it says; without, or with nonsense, the world counts as z-up."""
    scene, path = toy_scene(views=2, size=8), tmp_path / "a.glb"
    named = world if world in ("opencv", "LUF") else "z-up"
    write_mesh(path, solid.transformed(file_from_local(scene, "opengl", named)), RGB, world=named)
    if world not in ("opencv", "LUF", "z-up"):
        text = b'"z-up"'
        other = (b'"' + world.encode() + b'"') if world else b"null"
        data = path.read_bytes()
        assert data.count(text) == 1
        length = int.from_bytes(data[12:16], "little")
        chunk = data[20 : 20 + length].replace(text, other)
        chunk += b" " * (-len(chunk) % 4)
        whole = struct.pack("<III", *struct.unpack_from("<II", data), len(data) - length + len(chunk))
        path.write_bytes(whole + struct.pack("<I", len(chunk)) + data[16:20] + chunk + data[20 + length :])
    torch.testing.assert_close(mesh_from_file(path, scene).vertices, CORNERS, atol=1e-5, rtol=0)


def test_bad_files_get_a_sentence(solid: Mesh, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no format of meshes"):
        write_mesh(tmp_path / "a.stl", solid, RGB)
    assert not list(tmp_path.iterdir())
    for suffix in SUFFIXES:
        path = tmp_path / f"a{suffix}"
        for content in (b"", b"nonsense\n" * 20):
            path.write_bytes(content)
            with pytest.raises(InputError, match=r"mesh|triangles"):
                read_mesh(path)
    write_mesh(tmp_path / "a.glb", solid, RGB)
    whole = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "a.glb").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        read_mesh(tmp_path / "a.glb")
    with pytest.raises(FileNotFoundError):
        read_mesh(tmp_path / "missing.ply")
