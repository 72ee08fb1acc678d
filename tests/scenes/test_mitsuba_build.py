"""The procedural models: closed surfaces with the right volume and outward fronts, inside their bounds, the same each time."""

import math
from pathlib import Path

import numpy as np
import pytest

from invgraphics.errors import InputError
from invgraphics.scenes.mitsuba import job, ply
from invgraphics.scenes.mitsuba.build import mesh as meshes
from invgraphics.scenes.mitsuba.build.noise import fractal
from invgraphics.scenes.mitsuba.render import build
from invgraphics.scenes.mitsuba.spec import description_path, names, read


def _volume(mesh: meshes.Mesh) -> float:
    """By the divergence theorem; positive only where the faces wind counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def _agreement(mesh: meshes.Mesh) -> np.ndarray:
    """Cosines between each face's own normal and its vertices' mean normal; degenerate faces are left out."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    own = np.cross(b - a, c - a)
    length = np.linalg.norm(own, axis=1)
    keep = length > 1e-10
    mean = mesh.normals[mesh.faces].mean(axis=1)
    return ((own * mean).sum(1)[keep] / length[keep]) / np.linalg.norm(mean, axis=1)[keep]


def test_solids_have_their_volume():
    lo, hi = (-0.1, 0.2, 0.3), (0.9, 0.7, 0.6)
    assert _volume(meshes.box(lo, hi)) == pytest.approx(1.0 * 0.5 * 0.3)
    cut, edges = 0.02, np.subtract(hi, lo)
    # Twelve prisms of area c²/2 along the edges between the corners; at a corner of edge c, 5/6 c³ is cut away.
    lost = 4 * (edges - 2 * cut).sum() * cut**2 / 2 + 8 * cut**3 * 5 / 6
    assert _volume(meshes.box(lo, hi, cut)) == pytest.approx(edges.prod() - lost)
    sides = 64
    circle = sides / 2 * math.sin(2 * math.pi / sides)
    assert _volume(meshes.cylinder(0.5, 2.0, sides)) == pytest.approx(circle * 0.25 * 2)
    assert _volume(meshes.sphere((3, 2, 1), 0.5, rows=96)) == pytest.approx(4 / 3 * math.pi * 0.125, rel=2e-3)


def test_a_tube_has_its_volume_and_faces_outwards():
    t = np.linspace(0, 2 * np.pi, 200)
    ring = meshes.tube(np.stack([np.cos(t), np.sin(t), 0 * t], 1), 0.1, sides=40)
    assert _volume(ring) == pytest.approx(2 * math.pi**2 * 0.01, rel=0.01)
    assert _agreement(ring).min() > 0.99


def test_rotations_are_right_handed():
    assert np.allclose(meshes.rotation("z", 90) @ [1, 0, 0], [0, 1, 0])
    assert np.allclose(meshes.rotation("x", 90) @ [0, 1, 0], [0, 0, 1])
    assert np.allclose(meshes.rotation("y", 90) @ [0, 0, 1], [1, 0, 0])


@pytest.mark.parametrize("name", names())
def test_models_are_sound(name):
    spec = read(description_path(name))
    model = build(spec.builder, spec.seed)
    assert model.parts or model.fog
    assert model.lights or any(part.radiance for part in model.parts)
    for part in model.parts:
        for values in (part.mesh.vertices, part.mesh.normals, part.mesh.uv):
            assert np.isfinite(values).all()
        assert np.allclose(np.linalg.norm(part.mesh.normals, axis=1), 1, atol=1e-6)
        assert np.quantile(_agreement(part.mesh), 0.01) > 0.3  # fronts and shading normals on the same side
        assert (part.mesh.vertices >= np.array(spec.lo) - 1e-9).all()
        assert (part.mesh.vertices <= np.array(spec.hi) + 1e-9).all()
    if model.fog:
        assert model.fog.extinction.min() >= 0
        assert model.fog.extinction.max() > 0.5
        shell = np.ones(model.fog.extinction.shape, bool)
        shell[1:-1, 1:-1, 1:-1] = False
        assert model.fog.extinction[shell].max() < 0.05 * model.fog.extinction.max()


def test_a_scene_depends_on_its_own_builder_only():
    """The room has leaves of the fence; else builders are apart: a new scene leaves the others' pictures alone."""
    folder = Path(job.__file__).parent / "build"
    sources = {name: {path.stem for path in job._builder_sources(folder, name)} for name in ("room", "bricks", "unknown")}
    assert sources["room"] >= {"room", "fence", "mesh", "model", "noise", "surfaces"}
    assert "bricks" in sources["bricks"]
    assert not sources["bricks"] & {"room", "fence", "shelf"}
    assert not sources["unknown"]


def test_a_seed_makes_one_model():
    first, again, other = (build("fence", seed) for seed in (0, 0, 1))
    assert all(np.array_equal(a.mesh.vertices, b.mesh.vertices) for a, b in zip(first.parts, again.parts, strict=True))
    assert any(not np.array_equal(a.mesh.vertices, b.mesh.vertices) for a, b in zip(first.parts, other.parts, strict=True))


def test_noise_fills_its_range_and_is_smooth():
    values = fractal((40, 30, 20), 3, 1, np.random.default_rng(0))
    assert values.shape == (40, 30, 20)
    assert (values.min(), values.max()) == (0, 1)
    assert max(np.abs(np.diff(values, axis=axis)).max() for axis in range(3)) < 0.4


def test_ply_round_trip_and_weld(tmp_path: Path):
    box = meshes.box((0, 0, 0), (1, 1, 1))
    ply.write(tmp_path / "box.ply", box.vertices, box.faces, box.normals, box.uv)
    vertices, faces = ply.read(tmp_path / "box.ply")
    assert np.array_equal(vertices, box.vertices)
    assert np.array_equal(faces, box.faces)
    welded, corners = ply.weld(vertices, faces)
    assert (len(welded), len(corners)) == (8, 12)
    assert np.array_equal(welded[corners], vertices[faces])
    (tmp_path / "box.ply").write_bytes((tmp_path / "box.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match=r"box\.ply"):
        ply.read(tmp_path / "box.ply")
