"""Distances of surfaces: spheres and boxes in closed form, and what cameras do not see does not count."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Mesh, Model
from invgraphics.experiments.evaluate import score_model
from invgraphics.experiments.job import in_region
from invgraphics.experiments.surface_scores import mesh_scores
from invgraphics.fields.analytic import Box, Sphere
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.fields.mesh import MeshField, _box
from invgraphics.metrics.surface_metrics import SURFACE_METRICS
from invgraphics.metrics.surfaces import (
    compare_surfaces,
    nearest_on,
    sample_surface,
    triangle_distance,
    visible,
)
from invgraphics.renderers.sphere_tracing import SphereTracingConfig
from invgraphics.renderers.surface import SurfaceConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import TwoBalls, toy_cameras, toy_scene

BOX = Bounds(-torch.ones(3), torch.ones(3))
FEW = 10_000


def sphere(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    return extract_mesh(Sphere(1.0, radius, centre), BOX, 40).mesh


def test_a_mesh_without_area_is_refused() -> None:
    flat = Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    for mesh in (flat, Mesh(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64))):
        with pytest.raises(ValueError, match="no area"):
            sample_surface(mesh, 10, torch.Generator().manual_seed(0))


def test_distances_to_a_box_are_those_of_its_formula() -> None:
    """Exact, on twelve large triangles: no nearest sample could be so near."""
    mesh = _box(Bounds(torch.tensor([-0.5, -0.4, -0.3]), torch.tensor([0.5, 0.4, 0.3])))
    points = 2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 1
    distance, normal = nearest_on(mesh, points)
    expected = Box(1.0, (0.5, 0.4, 0.3)).sdf_at(points).abs()
    torch.testing.assert_close(distance.float(), expected, atol=1e-5, rtol=0)
    assert float((normal.abs().amax(dim=1) - 1).abs().max()) < 1e-6


def test_distance_to_a_triangle_by_dense_points() -> None:
    """Against a fine lattice of barycentric coordinates, for points beside, above and within the plane."""
    generator = torch.Generator().manual_seed(1)
    corners = torch.randn(30, 3, 3, generator=generator, dtype=torch.float64)
    points = 2 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    points[:5] = corners[:5].mean(dim=1)
    grid = torch.cartesian_prod(*[torch.linspace(0, 1, 201, dtype=torch.float64)] * 2)
    grid = grid[grid.sum(dim=1) <= 1]
    weights = torch.cat([1 - grid.sum(dim=1, keepdim=True), grid], dim=1)
    dense = torch.einsum("wk,nkc->nwc", weights, corners)
    expected = (dense - points[:, None]).norm(dim=2).amin(dim=1)
    assert bool((triangle_distance(points, corners) <= expected + 1e-12).all())
    torch.testing.assert_close(triangle_distance(points, corners), expected, atol=0.02, rtol=0)
    no_area = corners[:, [0, 1, 1]]
    assert bool(triangle_distance(points, no_area).isfinite().all())


def test_concentric_spheres() -> None:
    inner, outer = sphere(0.5), sphere(0.6)
    found = compare_surfaces(inner, outer, 0.11, count=FEW)
    assert (found.accuracy, found.completeness, found.chamfer) == pytest.approx((0.1, 0.1, 0.1), abs=2e-3)
    assert (found.precision, found.recall, found.f_score) == (1.0, 1.0, 1.0)
    assert found.normal_consistency > 0.99
    assert compare_surfaces(inner, outer, 0.09, count=2000).f_score == 0.0
    same = compare_surfaces(outer, outer, 1e-6, count=FEW)
    assert same.chamfer < 1e-4
    assert same.normal_consistency > 0.999


def test_half_a_sphere_is_right_but_not_complete() -> None:
    whole = sphere(0.6)
    half = replace(whole, faces=whole.faces[whole.vertices[whole.faces][:, :, 2].mean(dim=1) > 0])
    found = compare_surfaces(half, whole, 0.01, count=FEW)
    assert found.accuracy < 1e-4
    assert found.precision == 1.0
    assert found.recall == pytest.approx(0.5, abs=0.03)
    assert found.f_score == pytest.approx(2 / 3, abs=0.03)
    # The farthest points are 0.6 sqrt(2) from the rim, the mean over the lower half is 0.6 times ∫ 2 sin(φ/2) cos φ dφ.
    assert found.completeness == pytest.approx(0.5 * 0.6 * 0.5523, abs=0.015)


def test_normals_of_crossed_planes_disagree() -> None:
    flat = Mesh(torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))
    steep = Mesh(flat.vertices @ torch.tensor([[1.0, 0, 0], [0, 0.5, 0.75**0.5], [0, 0, 0]]), flat.faces)
    assert compare_surfaces(flat, steep, 1.0, count=1000).normal_consistency == pytest.approx(0.5, abs=1e-5)
    turned = replace(steep, faces=steep.faces.flip(1))
    assert compare_surfaces(flat, turned, 1.0, count=1000).normal_consistency == pytest.approx(0.5, abs=1e-5)


def test_points_are_uniform_by_area() -> None:
    """A spherical zone has its height's share of them."""
    points = sample_surface(sphere(0.5), FEW, torch.Generator().manual_seed(0)).position
    assert float((points[:, 2] > 0.25).double().mean()) == pytest.approx(0.25, abs=0.015)


def test_hidden_surface_does_not_count() -> None:
    """A ball inside of a ball, and what lies on the far side of all cameras."""
    outer, inner = sphere(0.6), sphere(0.3)
    both = Mesh(torch.cat([outer.vertices, inner.vertices]), torch.cat([outer.faces, inner.faces + len(outer.vertices)]))
    cameras = toy_cameras(12, 64)
    assert compare_surfaces(both, outer, 0.01, cameras, FEW).accuracy < 1e-4
    assert compare_surfaces(both, outer, 0.01, count=FEW).accuracy > 0.05
    points = sample_surface(outer, FEW, torch.Generator().manual_seed(0)).position
    seen = visible(outer, points, cameras[:1])
    towards = (points * (cameras[0].position.double() - points)).sum(dim=1) > 0  # in front of the horizon
    assert float((seen == towards).double().mean()) > 0.92
    elsewhere = cameras[0].moved(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ cameras[0].cam_to_world)
    with pytest.raises(ValueError, match="no camera sees the predicted surface"):
        compare_surfaces(inner, outer, 0.01, [replace(elsewhere, principal_point=torch.full((2,), 1e4))], 100)


def test_scores_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distances and meshes are scored in world units, densities are not, and what is missing is said."""
    monkeypatch.setattr("invgraphics.experiments.surface_scores.POINTS", FEW)
    monkeypatch.setattr("invgraphics.experiments.surface_scores.RESOLUTION", 48)
    truth = sphere(0.6)
    world = torch.diag(torch.tensor([10.0, 10.0, 10.0, 1.0]))
    scene = replace(toy_scene(views=4, size=8), mesh=truth, world_from_local=world)
    larger = Sphere(1.0, 0.62)
    distance = score_model(Model(larger, SphereTracingConfig().build(scene), scene.bounds), scene, "float", "distance")
    assert set(SURFACE_METRICS) <= set(distance.quality)
    chamfer = distance.quality["chamfer"]
    assert chamfer.mean == pytest.approx(0.2, abs=0.01)
    assert (chamfer.unit, chamfer.higher_is_better, chamfer.per_view) == ("world units", False, ())
    assert "0.2 world units" in distance.quality["f_score"].joined
    declared = "48 voxels along the longest edge, 0 pieces of less than 0.1% of the triangles left out"
    assert all(declared in distance.quality[name].joined for name in SURFACE_METRICS)
    mesh = Model(MeshField(truth, 0), SurfaceConfig().build(scene), scene.bounds)
    own = score_model(mesh, scene, "float", "mesh").quality["chamfer"]
    assert own.mean == pytest.approx(0.0, abs=1e-2) and "voxels" not in own.joined
    density = score_model(Model(TwoBalls(), VolumetricConfig().build(scene), scene.bounds), scene, "float", "density")
    assert "chamfer" not in density.quality
    assert "--to mesh" in density.skipped["chamfer"]
    _, skipped = mesh_scores(truth, replace(scene, mesh=None))
    assert skipped == dict.fromkeys(SURFACE_METRICS, "the scene has no true surface")


def test_the_f_score_of_a_run_in_its_own_box_has_the_data_sets_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two concentric spheres 0.03 apart: within 1 % of the data set's box (4 wide), not of the run's (1.4 wide)."""
    monkeypatch.setattr("invgraphics.experiments.surface_scores.POINTS", FEW)
    wide = Bounds(-2 * torch.ones(3), 2 * torch.ones(3))
    scene = replace(toy_scene(views=4, size=8), mesh=sphere(0.6), bounds=wide)
    tight = in_region(scene, ((-0.7,) * 3, (0.7,) * 3))
    again = in_region(tight, ((-0.65,) * 3, (0.65,) * 3))
    found = [mesh_scores(sphere(0.63), seen)[0]["f_score"] for seen in (scene, tight, again)]
    assert [score.mean for score in found] == [pytest.approx(1.0, abs=0.01)] * 3
    assert len({score.joined for score in found}) == 1
