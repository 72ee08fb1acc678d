"""Conversions against closed forms and the renderings they were made of, and a converted run as a run."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from training_fixtures import SMALL, write_blender

from invgraphics.cli import main
from invgraphics.core import Context, Field, Model, Samples, Scene
from invgraphics.core.field import Quantity
from invgraphics.core.samples import FieldValues
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.fields.analytic import Sphere
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.testing import TwoBalls, toy_scene
from invgraphics.tools.conversions import (
    TARGETS,
    quaternions_to,
    surface_points,
    to_gaussians,
    to_lattice,
    to_mesh,
    to_planes,
    to_points,
)
from invgraphics.tools.convert import ConvertRequest, convert_run

RADIUS, CENTRE = 0.6, torch.tensor([0.1, -0.1, 0.05])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=6, size=24, facing="forward")


def model_of(field: Field, scene: Scene) -> Model:
    return Model(field, VolumetricConfig(StratifiedConfig(192)).build(scene), scene.bounds)


def psnr(ours: Model, truth: Model, scene: Scene) -> float:
    errors = []
    for view in scene.test:
        pictures = [model.render(view.camera, normals=False).over(scene.background) for model in (ours, truth)]
        errors.append(float((pictures[0] - pictures[1]).square().mean()))
    return float(-10 * torch.tensor(errors).mean().log10())


def test_shortest_rotations_take_z_to_normals() -> None:
    normals = torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    normals = torch.cat([normals, torch.tensor([[0.0, 0, 1], [0, 0, -1]])])
    torch.testing.assert_close(quaternion_to_matrix(quaternions_to(normals))[:, :, 2], normals, atol=1e-5, rtol=0)


@pytest.mark.parametrize("hidden", [Quantity.NONE, Quantity.DENSITY])
def test_points_lie_on_the_surface_with_its_normals(scene: Scene, hidden: Quantity) -> None:
    """A hard ball: by its density, and, where that is not offered, by its depth pictures."""
    torch.manual_seed(0)
    ball = Sphere(200.0, RADIUS, CENTRE, colour=(0.2, 0.6, 0.4))
    model = model_of(ball, scene)
    ball.provides = ball.provides & ~hidden if hidden else ball.provides
    found = surface_points(model, scene, 300)
    outward = found.points.position - CENTRE
    assert float((outward.norm(dim=1) - RADIUS).abs().median()) < 0.02
    known = found.normals.norm(dim=1) > 0.5
    assert float(known.float().mean()) > 0.9
    cosine = (torch.nn.functional.normalize(outward, dim=1) * found.normals).sum(dim=1)[known]
    assert float(cosine.quantile(0.1)) > 0.9
    assert float((found.points.rgb - torch.tensor([0.2, 0.6, 0.4])).abs().median()) < 0.02
    assert float(found.points.position[:, 1].mean()) < float(CENTRE[1])  # only the side that cameras see


def test_gaussians_show_what_the_density_shows(scene: Scene) -> None:
    torch.manual_seed(0)
    truth = model_of(TwoBalls(), scene)
    method = load_method("splatting/gaussians", "laptop")
    field = to_gaussians(truth, scene, method, 300)
    assert len(field.means) == 300
    shown = Model(field, method.recipe.renderer.build(scene), scene.bounds)
    found = psnr(shown, truth, scene)
    assert found > 17
    usual = Model(method.recipe.field.build(scene), shown.renderer, scene.bounds)
    assert found > psnr(usual, truth, scene) + 3  # than the usual start from the scene's points
    with torch.no_grad():
        field.log_scales += 1.0  # what calibration avoids
    assert psnr(shown, truth, scene) < found - 2
    with pytest.raises(InputError, match="Gaussians already"):
        to_gaussians(shown, scene, method, 10)


@pytest.mark.parametrize("hidden", [Quantity.NONE, Quantity.DENSITY])
def test_neural_points_lie_where_the_model_is_seen(scene: Scene, hidden: Quantity) -> None:
    """In its colours, also of a model that offers no density; the networks are new, so nothing is said of pictures."""
    torch.manual_seed(0)
    ball = Sphere(200.0, RADIUS, CENTRE, colour=(0.2, 0.6, 0.4))
    model = model_of(ball, scene)
    ball.provides = ball.provides & ~hidden if hidden else ball.provides
    field = to_points(model, scene, load_method("volumetric/point-nerf", "laptop"), 200)
    assert float(((field.positions - CENTRE).norm(dim=1) - RADIUS).abs().median()) < 0.02
    assert float((field.raw_rgb.detach().sigmoid() - torch.tensor([0.2, 0.6, 0.4])).abs().median()) < 0.02
    with pytest.raises(InputError, match="no point cloud"):
        to_points(model, scene, load_method("volumetric/hash", "laptop"), 200)


class Tinted(TwoBalls):
    """The balls with colour in bands 0 and 1: it changes with the viewing direction's z."""

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        return FieldValues(
            density=values.density, radiance=0.5 + 0.3 * samples.direction[:, 2:] * torch.tensor([1.0, 0.5, 0.0])
        )


class Faint(TwoBalls):
    """The balls as thin fog."""

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        assert values.density is not None
        return FieldValues(density=1e-4 * values.density, radiance=values.radiance)


def lattice_settings(size: int) -> list[str]:
    return [f"field.encoding.resolution={size}", f"field.appearance.resolution={size}", "hooks=[]"]


@pytest.mark.parametrize("kind", [TwoBalls, Tinted])
def test_a_lattice_shows_what_the_density_shows(scene: Scene, kind: Callable[[], Any]) -> None:
    truth, method = model_of(kind(), scene), load_method("volumetric/plenoxels", "laptop", lattice_settings(40))
    field = to_lattice(truth, scene, method, 40)
    shown = Model(field, truth.renderer, scene.bounds)
    assert psnr(shown, truth, scene) > 19  # a jump of the density is blurred over a voxel
    # At vertices the density is exact, and the colour as far as the cameras see it.
    vertex = torch.tensor([[12, 22, 18], [29, 16, 25], [0, 0, 0]]) / 39
    position = scene.bounds.from_unit(vertex)
    towards = torch.nn.functional.normalize(position - scene.train[0].camera.position, dim=1)
    ours, theirs = (each.query(Samples.at(position, towards), Quantity.DENSITY | Quantity.RADIANCE) for each in (field, kind()))
    torch.testing.assert_close(ours.density, theirs.density, atol=1e-3, rtol=1e-4)
    solid = theirs.density > 0
    assert int(solid.sum()) == 2
    torch.testing.assert_close(ours.radiance[solid], theirs.radiance[solid], atol=0.03, rtol=0)


def test_a_lattice_takes_densities_through_a_relu_only(scene: Scene) -> None:
    method = load_method("volumetric/plenoxels", "laptop", [*lattice_settings(8), 'field.density_activation="softplus"'])
    with pytest.raises(InputError, match="only through a ReLU"):
        to_lattice(model_of(TwoBalls(), scene), scene, method, 8)


def test_planes_show_what_the_density_shows(scene: Scene) -> None:
    truth, method = model_of(TwoBalls(), scene), load_method("planes/mpi", "laptop", ["field.init='uniform'"])
    shown = Model(to_planes(truth, scene, method, 0), method.recipe.renderer.build(scene), scene.bounds)
    assert psnr(shown, truth, scene) > 19.5  # 18.5 where empty texels are black


def test_a_mesh_is_the_surface_of_the_density(scene: Scene) -> None:
    method = load_method("surface/mesh", "laptop", ["field.source='run'", "field.resolution=40"])
    field = to_mesh(model_of(TwoBalls(), scene), scene, method, 40)
    mesh, balls = field.primitives(Quantity.MESH, Context(scene.bounds)), TwoBalls()
    distance = ((mesh.vertices[:, None] - balls.centres).norm(dim=2) - balls.radii).abs().amin(dim=1)
    assert float(distance.max()) < 0.05  # a voxel
    shown = Model(field, method.recipe.renderer.build(scene), scene.bounds)
    assert psnr(shown, model_of(balls, scene), scene) > 17


def test_a_density_too_faint_for_a_mesh_is_told_what_convert_can_do(scene: Scene) -> None:
    method = load_method("surface/mesh", "laptop", ["field.source='run'", "field.resolution=16"])
    with pytest.raises(InputError, match="has no level") as caught:
        to_mesh(model_of(Faint(), scene), scene, method, 16)
    assert "--set field.level=" in caught.value.remedy and " --level" not in caught.value.remedy


def test_help_names_the_sizes_that_are_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.run(["convert", "--help"])
    shown = capsys.readouterr().out
    assert ConvertRequest(run=Path("a"), to="points", out=Path("b")).target.size == 15_000
    for target in TARGETS.values():
        assert not target.size or str(target.size) in shown


def test_a_converted_run_is_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a short fit of a hash grid to Gaussians, by the command; the folder opens, and knows where it comes from."""
    data = write_blender(toy_scene(views=6, size=20), tmp_path / "toy")
    native = tmp_path / "native"
    overrides = (*SMALL["volumetric/hash"], "data.train_views=4")
    request = FitRequest(scene=str(data), out=str(native), method="volumetric/hash", budget="100steps", overrides=overrides)
    fit_run(request)
    for to, method in (("gaussians", "volumetric/nerf"), ("mesh", "splatting/gaussians")):
        with pytest.raises(InputError, match=f"--method {method} has another field than --to {to} makes"):
            convert_run(ConvertRequest(run=native, to=to, out=tmp_path / "other", method=method))
    for method, hook in (("splatting/gaussians-mcmc", "relocation"), ("splatting/gaussians-mip", "smoothing")):
        with pytest.raises(InputError, match=f"--method {method} relies on its hook '{hook}'"):
            convert_run(ConvertRequest(run=native, to="gaussians", out=tmp_path / "other", method=method))
    out = tmp_path / "gaussians"
    command = ["convert", str(native), "--to", "gaussians", "--size", "300", "--refit", "30steps", "--out", str(out)]
    assert main.run(command) == 0
    shown = capsys.readouterr().out.replace(str(tmp_path), "")
    assert "converted" in shown
    origin = RunFolder(out).read(Provenance).converted
    assert origin is not None
    assert (origin.run, origin.method, origin.to) == (str(native), "volumetric/hash", "gaussians")
    assert origin.cell_sha256 == RunFolder(native).identity
    seen, fitted = (RunFolder(folder).read(Provenance) for folder in (out, native))
    assert seen.data == fitted.data == {"train_views": 4}
    assert seen.train_sha256 == fitted.train_sha256, "the refit sees no other photographs than the fit did"
    scores = RunFolder(out).read_scores()
    assert origin.native_psnr == RunFolder(native).read_scores().quality["psnr"].mean
    assert scores.quality["psnr"].mean > origin.converted_psnr + 1
    assert scores.cost["steps"] == 30
    assert open_fitted(out).model.field.primitive_count() >= 300
    assert main.run(command) == 2  # the folder is taken
    assert main.run([*command[:2], "--to", "clouds", "--out", str(tmp_path / "x")]) == 2


def test_what_cannot_be_is_refused(scene: Scene) -> None:
    class Blind(TwoBalls):
        provides = Quantity.RADIANCE

    blind = SimpleNamespace(field=Blind(), bounds=scene.bounds)
    with pytest.raises(InputError, match="not density and radiance"):
        to_planes(cast(Model, blind), scene, load_method("planes/mpi", "laptop"), 0)
    with pytest.raises(InputError, match="mpi has no size of its own"):
        ConvertRequest(run=Path("a"), to="mpi", out=Path("b"), size=3)
