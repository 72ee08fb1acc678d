"""Meshes of fields: a ball keeps its radius, Gaussians fuse to a closed surface, files open elsewhere."""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from training_fixtures import SMALL, TOY_STEPS

import invgraphics as ig
from invgraphics.cli import main
from invgraphics.core import Bounds, Camera, Context, Mesh, Quantity, Rendering
from invgraphics.errors import InputError
from invgraphics.experiments import fitted as opened
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.fields.analytic import GaussianBlob, Sphere
from invgraphics.fields.depth_fusion import fuse_depth
from invgraphics.fields.isosurface import VoxelGrid, default_level, extract_mesh, without_specks
from invgraphics.fields.mesh import MeshField
from invgraphics.formats.mesh import mesh_from_file, read_mesh
from invgraphics.renderers.splatting import Splatting, SplattingConfig
from invgraphics.runs.folder import RunFolder
from invgraphics.studies.approximations import field_of, isotropic_gaussians
from invgraphics.testing import TwoBalls, toy_cameras
from invgraphics.tools.export import PLANES, RESOLUTION, ExportRequest, export_run

BOX = Bounds(-torch.ones(3), torch.ones(3))


def _volume(surface: Mesh) -> float:
    """Signed volume by the divergence theorem: positive where faces look outwards."""
    a, b, c = surface.vertices.double()[surface.faces].unbind(dim=1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


class _Density(Sphere):
    """A ball without a signed distance."""

    provides = Quantity.DENSITY | Quantity.RADIANCE


@pytest.mark.parametrize("kind", [Sphere, _Density])
def test_a_ball_keeps_its_radius(kind: type[Sphere]) -> None:
    centre = torch.tensor([0.1, -0.2, 0.05])
    surface = extract_mesh(kind(50.0, 0.6, centre, colour=(0.2, 0.6, 0.4)), BOX, 40).mesh
    radii = (surface.vertices - centre).norm(dim=1)
    # Half a voxel of 2/40 for a density with a jump; next to nothing for a distance.
    assert float((radii - 0.6).abs().max()) < (0.026 if kind is _Density else 2e-3)
    assert _volume(surface) == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=0.05)
    assert surface.open_edges() == 0
    assert surface.rgb.unique(dim=0).flatten().tolist() == pytest.approx([0.2, 0.6, 0.4])


def test_a_distance_that_is_nowhere_is_told_with_its_sign() -> None:
    with pytest.raises(InputError, match="The signed distance has no level") as caught:
        extract_mesh(Sphere(50.0, 0.6), BOX, 16, -5.0)
    level, least, most = (float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", caught.value.sentence))
    assert level == -5
    # Where no surface can be, a block of 4 voxels has the distance of its centre; around the box is one voxel of 1/8 more.
    assert least == pytest.approx(0.25 * 3**0.5 - 0.6, abs=1e-3)
    assert most == pytest.approx(0.75 * 3**0.5 - 0.6 + 0.125, abs=1e-3)


def test_the_level_of_a_density_is_where_the_surface_is() -> None:
    blob = GaussianBlob(peak=100.0, covariance=0.09)
    for level in (default_level(BOX), 60.0):
        surface = extract_mesh(blob, BOX, 48, level).mesh
        expected = 0.3 * math.sqrt(2 * math.log(100 / level))
        assert float((surface.vertices.norm(dim=1) - expected).abs().max()) < 0.01
    # The stated meaning: 1% of the diagonal of this density has alpha 1/2.
    assert 1 - math.exp(-default_level(BOX) * 0.01 * 2 * math.sqrt(3)) == pytest.approx(0.5)
    with pytest.raises(InputError, match="no level 200"):
        extract_mesh(blob, BOX, 16, 200.0)


def test_a_solid_that_leaves_the_box_is_closed_there() -> None:
    surface = extract_mesh(_Density(50.0, 1.2), BOX, 24).mesh
    assert surface.open_edges() == 0
    assert float(surface.vertices.abs().max()) < 1.05


def test_colours_are_those_of_the_place() -> None:
    surface = extract_mesh(TwoBalls(), BOX, 40).mesh
    left, right = surface.vertices[:, 0] < 0, surface.vertices[:, 0] > 0.2
    assert bool((surface.rgb[left, 0] > surface.rgb[left, 2]).all()), "the left ball is red"
    assert bool((surface.rgb[right, 0] < surface.rgb[right, 2]).all()), "the right ball is blue"


def test_colours_are_seen_from_outside() -> None:
    """A field whose colour is the direction of looking: it is the inward normal."""

    class Looking(_Density):
        def radiance_along(self, direction: torch.Tensor) -> torch.Tensor:
            return (direction + 1) / 2

    surface = extract_mesh(Looking(50.0, 0.6), BOX, 40).mesh
    along = ((2 * surface.rgb - 1) * surface.vertices).sum(dim=1) / 0.6
    assert float(along.max()) < -0.5  # stairs of voxels turn some normals
    assert float(along.mean()) < -0.9


def test_specks_are_left_out() -> None:
    """A small tetrahedron beside a ball."""
    ball = extract_mesh(_Density(50.0, 0.6), BOX, 40).mesh
    n = len(ball.vertices)
    corners = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    places = torch.cat([ball.vertices, 0.9 + 0.01 * torch.eye(4)[:, :3]])
    left = without_specks(Mesh(places, torch.cat([ball.faces, corners + n])))
    assert (len(left.mesh.faces), len(left.mesh.vertices), left.dropped) == (len(ball.faces), n, 1)
    assert torch.equal(left.mesh.vertices[left.mesh.faces], ball.vertices[ball.faces])


def test_of_nothing_but_specks_the_largest_stay() -> None:
    """A thousand tetrahedra and more, of which each has less than a thousandth of the faces."""
    corners = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    beads = 1100
    places = torch.cat([torch.eye(4)[:, :3] + 2 * i for i in range(beads)])
    left = without_specks(Mesh(places, torch.cat([corners + 4 * i for i in range(beads)])))
    assert (len(left.mesh.faces), left.dropped) == (4 * beads, 0)


def _all_around() -> list[Camera]:
    cameras = [*toy_cameras(24, 72), *toy_cameras(8, 72, turn=0.5)]
    upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    return [*cameras, *(camera.moved(upside_down @ camera.cam_to_world) for camera in cameras)]


def _ball(camera: Camera, radius: float) -> Rendering:
    """A ball at the origin in closed form, coloured by place."""
    rays = camera.rays()
    middle = -(rays.origins * rays.directions).sum(dim=1)
    half = radius**2 - (rays.origins + middle[:, None] * rays.directions).square().sum(dim=1)
    depth = torch.where(half > 0, middle - half.clamp_min(0).sqrt(), torch.inf)
    place = rays.at(torch.where(half > 0, depth, 0.0))
    alpha = (half > 0).float()
    normal = torch.nn.functional.normalize(place, dim=1) * alpha[:, None]
    return Rendering((place + 1) / 2 * alpha[:, None], alpha, depth, normal).reshape(camera.height, camera.width)


def test_exact_depth_pictures_fuse_to_the_ball() -> None:
    cameras = _all_around()
    surface = fuse_depth(cameras, lambda index: _ball(cameras[index], 0.55), BOX, 48).mesh
    radii = surface.vertices.norm(dim=1)
    assert float((radii - 0.55).abs().mean()) < 0.01  # a quarter of a voxel
    assert _volume(surface) == pytest.approx(4 / 3 * math.pi * 0.55**3, rel=0.08)  # three such quarters
    assert surface.open_edges() == 0
    assert float((surface.rgb - (surface.vertices + 1) / 2).abs().mean()) < 0.03


def test_voxels_that_do_not_fit_into_memory_are_refused_before_a_picture_is_rendered() -> None:
    with pytest.raises(InputError, match=r"Depth fusion with 1,000,000,000,000 voxels needs about 24,000 GB"):
        fuse_depth(_all_around(), lambda index: pytest.fail("rendered"), BOX, 10_000)


def test_gaussians_on_a_sphere_fuse_to_the_sphere() -> None:
    """Splats are fat: seen aslant, their surface lies up to two standard deviations outside of their centres."""
    direction = torch.nn.functional.normalize(torch.randn(3000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    means = 0.55 * direction
    field = field_of(isotropic_gaussians(means, torch.full((3000,), 0.02), torch.full((3000,), 0.95), (means + 1) / 2)).float()
    renderer, cameras = Splatting(SplattingConfig(depth="median", normals="depth")), _all_around()[::2]

    def render(index: int) -> Rendering:
        with torch.no_grad():
            return renderer.render_image(field, cameras[index], Context(BOX, geometry=True))[0]

    surface = fuse_depth(cameras, render, BOX, 48).mesh
    radii = surface.vertices.norm(dim=1)
    assert 0.55 < float(radii.median()) < 0.59
    assert _volume(surface) == pytest.approx(4 / 3 * math.pi * 0.57**3, rel=0.12)
    assert surface.open_edges() < 0.02 * len(surface.faces)
    assert float((surface.rgb - (surface.vertices / 0.57 * 0.55 + 1) / 2).abs().mean()) < 0.06


def test_what_no_picture_saw_stays_open() -> None:
    """A wall seen from one side: one sheet, not two."""
    camera = toy_cameras(1, 48)[0]
    axis = camera.cam_to_world[:3, 2]
    rays = camera.rays()
    depth = ((-camera.position) @ axis / (rays.directions @ axis)).view(48, 48)  # the plane through the origin
    wall = Rendering(torch.full((48, 48, 3), 0.5), torch.ones(48, 48), depth)
    surface = fuse_depth([camera], lambda _: wall, BOX, 24).mesh
    assert float((surface.vertices @ axis).abs().max()) < 0.02  # a quarter of a voxel
    assert surface.open_edges() > 0
    with pytest.raises(InputError, match="depth pictures"):
        fuse_depth([camera], lambda _: replace(wall, depth=torch.full((48, 48), torch.inf)), BOX, 24)


def test_lattice_covers_the_box_with_cubes() -> None:
    lattice = VoxelGrid.across(Bounds(torch.zeros(3), torch.tensor([2.0, 1.0, 0.5])), 8)
    assert lattice.shape == (8, 4, 2)
    centres = lattice.centres(0, len(lattice))
    assert (centres.amin(dim=0).tolist(), centres.amax(dim=0).tolist()) == ([0.125] * 3, [1.875, 0.875, 0.375])


@pytest.mark.parametrize("method", ["volumetric/hash", "splatting/gaussians"])
def test_a_run_becomes_a_file(toy_runs: dict[str, Path], tmp_path: Path, capsys, monkeypatch, method: str) -> None:
    """In the world's coordinates, readable by plyfile; the toy's balls are where they are."""
    similarity = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0]))
    similarity[:3, 3] = torch.tensor([10.0, 0.0, 0.0])
    opener = opened.open_scene
    monkeypatch.setattr(opened, "open_scene", lambda *words: replace(opener(*words), world_from_local=similarity))
    out = tmp_path / "model.ply"
    level = ["--level", "1"] if method == "volumetric/hash" else []
    assert (
        main.run(["export", str(toy_runs[method]), "--to", "mesh", "--out", str(out), "--resolution", "32", *level])
        == main.DONE
    )
    said = capsys.readouterr().out
    assert ("density 1 per local unit" if level else "median depth of 12 training views") in said
    file = PlyData.read(out)
    vertex = file["vertex"].data
    places = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    assert f"{len(places):,}" in said
    local = torch.from_numpy((places - [10, 0, 0]) / 2).float()
    distance = ((local[:, None] - TwoBalls().centres).norm(dim=-1) - TwoBalls().radii).amin(dim=1).abs()
    assert float(distance.median()) < 0.12
    faces = np.stack(file["face"].data["vertex_indices"])
    assert faces.shape[1] == 3
    assert faces.max() < len(places)
    assert vertex["red"].dtype == np.uint8
    assert vertex["red"].std() > (1 if level else 10)


def test_bad_requests_get_a_sentence(toy_runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.run(["export", "--help"])
    helped = " ".join(capsys.readouterr().out.split())
    assert all(f"(default: {default})" in helped for default in (RESOLUTION, PLANES))
    with pytest.raises(InputError, match="--resolution"):
        ExportRequest(toy_runs["volumetric/hash"], "mesh", tmp_path / "a.ply", resolution=2)
    with pytest.raises(InputError, match="no density with a level"):
        export_run(ExportRequest(toy_runs["splatting/gaussians"], "mesh", tmp_path / "a.ply", level=3.0))
    with pytest.raises(InputError, match=r"no level.*\nChoose another --level"):
        export_run(ExportRequest(toy_runs["volumetric/hash"], "mesh", tmp_path / "a.ply", level=1e9, resolution=16))
    assert not list(tmp_path.iterdir())


def test_a_fitted_density_is_seen_as_a_mesh(toy_runs: dict[str, Path], toy_folder: Path, tmp_path: Path) -> None:
    """Through the surface renderer, as a rendering beside the run, and with colours refitted, from the run and from a file."""
    source = Path(shutil.copytree(toy_runs["volumetric/hash"], tmp_path / "hash"))
    shared = {"scene": str(toy_folder), "existing": "reuse"}
    steps, small = TOY_STEPS["volumetric/hash"], (*SMALL["volumetric/hash"],)
    again = {"method": "volumetric/hash", "budget": f"{steps}steps", "overrides": small, "out": str(source)}
    variant = "surface/mesh:resolution=32:level=1.0"
    fit_run(FitRequest(**shared, **again, render_with=(variant,)))
    (folder,) = (source / "rendered").iterdir()
    shown = RunFolder(folder).read_scores()
    run = ig.load_run(source)
    model = run.through(variant)
    picture = model.render(run.scene.test[0].camera)
    ninths = 9 * picture.alpha  # opaque triangles, 9 rays each
    torch.testing.assert_close(ninths, ninths.round(), atol=1e-4, rtol=0)
    native = run.scores["psnr"]
    assert 15 < shown.quality["psnr"].mean < native  # a level of 1 makes the fog thick
    assert shown.quality["alpha_iou"].mean > 0.7

    out = tmp_path / "refitted"
    common = {**shared, "method": "surface/mesh", "budget": "60steps"}
    settings = (f"field.source={source}", "field.resolution=32", "field.level=1.0", "field.sh_degree=1")
    fit_run(FitRequest(**common, out=str(out), overrides=settings))
    refitted = ig.load_run(out)
    assert refitted.scores["psnr"] > shown.quality["psnr"].mean
    exported = export_run(ExportRequest(out, "mesh", tmp_path / "refitted.glb"))
    assert exported.facts["surface"] == "the mesh of the field"
    with pytest.raises(InputError, match=r"is a mesh already\.\nLeave --resolution out"):
        export_run(ExportRequest(out, "mesh", tmp_path / "a.glb", resolution=64))
    back = mesh_from_file(exported.path, run.scene)
    field = refitted.model.field
    torch.testing.assert_close(back.vertices, field.vertices, atol=1e-5, rtol=0)
    # glTF is y-up: the file's second axis is the world's third.
    torch.testing.assert_close(read_mesh(exported.path).vertices[:, 1], field.vertices[:, 2], atol=1e-5, rtol=0)
    third = tmp_path / "from-file"
    fit_run(FitRequest(**common, out=str(third), overrides=(f"field.source={exported.path}", "field.sh_degree=1")))
    assert ig.load_run(third).scores["psnr"] == pytest.approx(refitted.scores["psnr"], abs=0.3)


def test_a_mesh_is_fitted_from_photographs_alone(toy_folder: Path, tmp_path: Path) -> None:
    """The visual hull, coloured: better than the source's fog, and the same after reopening."""
    request = FitRequest(
        method="surface/mesh",
        scene=str(toy_folder),
        out=str(tmp_path / "hull"),
        budget="40steps",
        overrides=("field.resolution=40",),
    )
    run = ig.load_run(fit_run(request))
    assert run.scores["psnr"] > 20
    assert run.scores["alpha_iou"] > 0.85
    assert isinstance(run.model.field, MeshField)
    first, last = run.history[0].psnr, run.history[-1].psnr
    assert first is not None
    assert last is not None
    assert last > first
    with pytest.raises(InputError, match="is a mesh already"):
        export_run(ExportRequest(tmp_path / "hull", "mesh", tmp_path / "a.ply", level=1.0))
    with pytest.raises(InputError, match="no format of meshes"):
        export_run(ExportRequest(tmp_path / "hull", "mesh", tmp_path / "a.stl"))
