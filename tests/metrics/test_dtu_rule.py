"""DTU's rule on spheres with known distances, and the files that it needs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.io import savemat

from invgraphics.core import Bounds, Mesh
from invgraphics.core.scan import Scan
from invgraphics.errors import InputError
from invgraphics.experiments.surface_scores import mesh_scores
from invgraphics.fields.analytic import Sphere
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.metrics import dtu
from invgraphics.metrics.dtu import dtu_score
from invgraphics.metrics.surfaces import sample_surface
from invgraphics.scenes.dtu import find_scan
from invgraphics.testing import toy_scene

RADIUS = 8.0


def sphere(radius: float) -> Mesh:
    bounds = Bounds(torch.full((3,), -12.5), torch.full((3,), 12.5))
    return extract_mesh(Sphere(1.0, radius), bounds, 40).mesh


def fibonacci(radius: float, count: int = 4_000) -> torch.Tensor:
    """Points 0.45 mm apart on a sphere."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * index / count, index * torch.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    return radius * torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=1)


@pytest.fixture
def scan() -> Scan:
    """The upper half is above the table, and voxels are observed where x < 0."""
    observed = torch.zeros(11, 11, 11, dtype=torch.bool)
    observed[:6] = True
    plane = torch.tensor([0.0, 0.0, 1.0, 0.0]).double()
    return Scan(fibonacci(RADIUS), observed, torch.full((3,), -25.0).double(), 5.0, plane)


def test_concentric_spheres(scan: Scan) -> None:
    found = dtu_score(sphere(9.0), scan)
    # To the nearest scanned point, at most 0.35 mm beside: sqrt(1 + 0.3²) at the middle of four.
    assert found.accuracy == pytest.approx(1.02, abs=0.02)
    assert found.completeness == pytest.approx(1.0, abs=0.02)
    assert found.overall == pytest.approx((found.accuracy + found.completeness) / 2)


def test_only_what_was_observed_counts(scan: Scan) -> None:
    """A wrong half where nobody looked costs nothing, below the table nothing is missing, and outliers are left out."""
    exact, wrong = sphere(RADIUS), sphere(12.0)
    unseen = wrong.faces[wrong.vertices[wrong.faces][:, :, 0].amin(dim=1) > 2.6]  # half a voxel beyond the observed ones
    both = Mesh(torch.cat([exact.vertices, wrong.vertices]), torch.cat([exact.faces, unseen + len(exact.vertices)]))
    right = dtu_score(exact, scan)
    assert right.overall < 0.2
    assert dtu_score(both, scan).accuracy == pytest.approx(right.accuracy, abs=0.01)
    assert dtu_score(both, replace(scan, observed=None)).accuracy > 1.0
    upper = replace(exact, faces=exact.faces[exact.vertices[exact.faces][:, :, 2].amin(dim=1) > -1.0])
    assert dtu_score(upper, scan).completeness == pytest.approx(right.completeness, abs=0.02)
    assert dtu_score(upper, replace(scan, plane=None)).completeness > 1.0
    stray = torch.tensor([[-24.0, 24.0, 24.0], [-24.0, 24.2, 24.0], [-24.0, 24.0, 24.2]])  # 33 mm off
    strays = Mesh(torch.cat([exact.vertices, stray]), torch.cat([exact.faces, torch.arange(3)[None] + len(exact.vertices)]))
    assert dtu_score(strays, scan).accuracy == pytest.approx(right.accuracy, abs=0.01)
    with pytest.raises(ValueError, match="where the scanner looked"):
        dtu_score(Mesh(exact.vertices + 500, exact.faces), scan)


def thinned_at_once(mesh: Mesh, scan: Scan) -> tuple[float, float]:
    """The rule by other means: all random points at once, thinned by a dictionary of cubes, distances by brute force."""
    count = round(2 * float(trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False).area) / 0.2**2)
    drawn = sample_surface(mesh, count, torch.Generator().manual_seed(0)).position
    cubes: dict[tuple, int] = {}
    for index, cube in enumerate(map(tuple, (drawn / 0.2).floor().tolist())):
        cubes.setdefault(cube, index)
    points = drawn[list(cubes.values())]
    seen = points[scan.sees(points)]
    means = []
    for one, other in ((seen, scan.points), (scan.above_table(), points)):
        nearest = torch.cat([torch.cdist(part, other).amin(dim=1) for part in one.split(500)])
        means.append(float(nearest[nearest < 20].mean()))
    return means[0], means[1]


def test_the_rule_by_other_means(scan: Scan) -> None:
    found = dtu_score(sphere(9.0), scan)
    assert (found.accuracy, found.completeness) == pytest.approx(thinned_at_once(sphere(9.0), scan), abs=1e-9)
    assert found.density == pytest.approx(50)


def test_large_surfaces_are_sampled_as_densely_as_small_ones(scan: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sheet 30 mm away has 30 times the sphere's area: with a cap on the points it would cost the sphere its density."""
    small = sphere(RADIUS)
    corner = torch.tensor([[-80.0, -80.0, 50.0], [80.0, -80.0, 50.0], [80.0, 80.0, 50.0], [-80.0, 80.0, 50.0]])
    sheet = torch.tensor([[0, 1, 2], [0, 2, 3]]) + len(small.vertices)
    large = Mesh(torch.cat([small.vertices, corner]), torch.cat([small.faces, sheet]))
    monkeypatch.setattr(dtu, "CHUNK", 40_000)  # the sphere alone takes one chunk
    alone, beside = dtu_score(small, scan), dtu_score(large, scan)
    assert beside.completeness == pytest.approx(alone.completeness, abs=0.002)
    assert beside.density == alone.density == dtu.DENSITY
    monkeypatch.setattr(dtu, "MOST_POINTS", 40_000)
    capped = dtu_score(large, scan)
    assert capped.completeness > alone.completeness + 0.005
    assert capped.density == pytest.approx(40_000 / (160**2 + 4 * torch.pi * RADIUS**2), rel=0.01)
    quality, _ = mesh_scores(large, replace(toy_scene(views=2, size=4), scan=scan))
    assert "instead of 50 random points per mm²" in quality["chamfer"].joined


def test_files_beside_the_cameras(scan: Scan, tmp_path: Path) -> None:
    """As DTU's archives name them; what is not there is said."""
    assert find_scan(tmp_path)[0] is None
    assert "no reference scan" in find_scan(tmp_path)[1]
    (tmp_path / "Points").mkdir()
    trimesh.PointCloud(scan.points.numpy()).export(tmp_path / "Points" / "stl024_total.ply")
    found, lacks = find_scan(tmp_path)
    assert found is not None
    np.testing.assert_allclose(found.points, scan.points, atol=1e-5)
    assert "no observation mask" in lacks
    assert "no table plane" in lacks
    assert scan.observed is not None
    box = np.array([[-25.0] * 3, [25.0] * 3])
    savemat(tmp_path / "ObsMask24_10.mat", {"ObsMask": scan.observed.numpy(), "BB": box, "Res": 5.0})
    savemat(tmp_path / "Plane24.mat", {"P": np.array([[0.0], [0.0], [1.0], [0.0]])})
    savemat(tmp_path / "Plane240.mat", {"P": np.ones((4, 1))})
    found, lacks = find_scan(tmp_path)
    assert found is not None
    assert lacks == ""
    assert found.observed is not None
    assert torch.equal(found.observed, scan.observed)
    assert found.plane is not None
    assert found.plane.tolist() == [0, 0, 1, 0]
    mesh = sphere(9.0)
    assert dtu_score(mesh, found).accuracy == pytest.approx(dtu_score(mesh, scan).accuracy, abs=1e-4)
    for broken in ({"BB": box[:1]}, {"Res": 0.0}, {"Res": []}, {"ObsMask": np.ones(3)}, {"BB": "words"}):
        savemat(tmp_path / "ObsMask24_10.mat", {"ObsMask": scan.observed.numpy(), "BB": box, "Res": 5.0} | broken)
        with pytest.raises(InputError, match="ObsMask24_10"):
            find_scan(tmp_path)
    (tmp_path / "ObsMask24_10.mat").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="ObsMask24_10"):
        find_scan(tmp_path)


def test_scores_are_millimetres_of_the_world(scan: Scan) -> None:
    """The mesh is local; the scan is in the world, which is ten times as large."""
    world = torch.diag(torch.tensor([10.0, 10.0, 10.0, 1.0]))
    scene = replace(toy_scene(views=2, size=4), scan=scan, world_from_local=world, notes={"reference_scan": "with mask"})
    mesh = sphere(9.0)
    quality, skipped = mesh_scores(replace(mesh, vertices=mesh.vertices / 10), scene)
    assert quality["surface_completeness"].mean == pytest.approx(1.0, abs=0.02)
    assert quality["chamfer"].unit == "mm"
    assert "with mask" in quality["chamfer"].joined
    assert set(skipped) == {"f_score", "normal_consistency"}
    _, skipped = mesh_scores(mesh, replace(scene, scan=None, notes={"reference_scan": "the data set has no reference scan"}))
    assert skipped["chamfer"] == "the data set has no reference scan"
