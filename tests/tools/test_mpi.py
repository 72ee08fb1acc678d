"""Slices of a density against volume rendering, and files of planes: exported, read back, damaged, refused."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from invgraphics.core import Context, Model, Planes, Quantity, Scene
from invgraphics.core.planes import inverse_depths, mean_camera
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted
from invgraphics.fields.planes import FixedPlanes, PlanesConfig
from invgraphics.fields.slicing import SUBSAMPLES, slab_edges, slice_density
from invgraphics.formats.mpi import PlaneFile, read_mpi, write_mpi
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.planes import PlaneRenderer
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import TwoBalls, toy_scene
from invgraphics.tools.export import ExportRequest
from invgraphics.tools.mpi import export_mpi, moved


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=4, size=16, facing="forward")


def fitted(scene: Scene, field: Any, renderer: Any, method: str) -> Fitted:
    model = Model(field, renderer, scene.bounds)
    return Fitted(None, load_method(method), scene, model, None)  # type: ignore[arg-type]


def volumetric(scene: Scene) -> Any:
    return VolumetricConfig(StratifiedConfig(256)).build(scene)


def test_slices_are_the_volume_rendering_from_the_reference(scene: Scene) -> None:
    camera = mean_camera([view.camera for view in scene.train])
    planes = slice_density(TwoBalls(), camera, inverse_depths(2.0, 4.2, 24).float(), scene.bounds)
    context = Context(scene.bounds)
    ours, _ = PlaneRenderer().render_image(FixedPlanes(planes), camera, context)
    truth, _ = volumetric(scene).render_image(TwoBalls(), camera, context)
    torch.testing.assert_close(ours.alpha, truth.alpha, atol=0.06, rtol=0)  # thin edges, by 8 samples a slab
    assert float((ours.rgb - truth.rgb).abs().mean()) < 3e-3
    solid = truth.alpha > 0.99
    assert float((ours.depth - truth.depth)[solid].abs().max()) < 0.15  # the spacing of the planes


def test_slabs_meet_between_the_planes(scene: Scene) -> None:
    depths = inverse_depths(2.0, 4.0, 5)
    for space in ("box", "contracted"):
        edges = slab_edges(depths, replace(scene.bounds, space=space))
        assert len(edges) == 5 * SUBSAMPLES + 1
        between = 1 / edges[SUBSAMPLES:-1:SUBSAMPLES]
        torch.testing.assert_close(between, ((1 / depths)[1:] + (1 / depths)[:-1]) / 2)
        assert bool((edges.diff() > 0).all())
        assert (float(edges[-1]) > 900) == (space == "contracted")


def test_export_and_back(scene: Scene, tmp_path: Path) -> None:
    """A density is sliced, written and read; layers are plain PNG files, and the world has another scale and frame."""
    similarity = torch.tensor([[0.0, -2.0, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    elsewhere = replace(scene, world_from_local=similarity)
    request = ExportRequest(Path("run"), "mpi", tmp_path / "balls.zip", planes=12)
    exported = export_mpi(fitted(elsewhere, TwoBalls(), volumetric(scene), "volumetric/nerf"), request)
    assert exported.facts["planes"].startswith("12 of ")
    with zipfile.ZipFile(exported.path) as archive:
        description = json.loads(archive.read("mpi.json"))
        assert [layer["file"] for layer in description["layers"]] == sorted(archive.namelist()[1:])
        picture = Image.open(io.BytesIO(archive.read("layers/005.png")))
        assert picture.mode == "RGBA"
    planes = read_mpi(exported.path).planes
    config = PlanesConfig(count=12)
    camera, depths = config.placed(scene)
    torch.testing.assert_close(planes.depths, 2 * depths)
    position = similarity[:3, :3] @ camera.position + similarity[:3, 3]
    torch.testing.assert_close(planes.camera.position, position, atol=1e-5, rtol=0)
    torch.testing.assert_close(planes.camera.cam_to_world[:3, :3] @ planes.camera.cam_to_world[:3, :3].T, torch.eye(3))
    sliced = slice_density(TwoBalls(), camera, depths, scene.bounds)
    assert float((planes.alpha - sliced.alpha).abs().max()) <= 0.5 / 255 + 1e-6
    assert np.asarray(picture).shape[:2] == (camera.height, camera.width)
    # In the scene's frame again, the file shows what the slices show.
    back = moved(planes, torch.linalg.inv(similarity), 0.5)
    shown, expected = (
        PlaneRenderer().render_image(FixedPlanes(each), scene.test[0].camera, Context(scene.bounds))[0]
        for each in (back, sliced)
    )
    torch.testing.assert_close(shown.rgb, expected.rgb, atol=0.02, rtol=0)


def test_planes_are_written_as_they_are(scene: Scene, tmp_path: Path) -> None:
    torch.manual_seed(0)
    field = PlanesConfig(count=3, basis=1).build(scene)
    run = fitted(scene, field, PlaneRenderer(), "planes/mpi")
    facts = export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "a.zip")).facts
    assert "view dependence" in facts["left out"]
    assert float(facts["PSNR to the run's own pictures"].split()[0].rstrip(",")) > 45
    back = read_mpi(tmp_path / "a.zip").planes
    with torch.no_grad():
        own = field.primitives(Quantity.PLANES, Context(scene.bounds))
    assert float((back.rgb - own.rgb).abs().max()) <= 0.5 / 255 + 1e-6
    for idle, option in (({"view": "train0"}, "--view"), ({"planes": 64}, "--planes")):
        with pytest.raises(InputError, match=rf"has planes of its own\.\nLeave {option} out"):
            export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "c.zip", **idle))
    assert not (tmp_path / "c.zip").exists()
    export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "b.zip"))
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_cameras_all_around_need_a_view(tmp_path: Path) -> None:
    around = toy_scene(views=4, size=12)
    run = fitted(around, TwoBalls(), volumetric(around), "volumetric/nerf")
    with pytest.raises(InputError, match=r"look all ways.*\nName one with --view, for instance train0"):
        export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "x.zip"))
    facts = export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "x.zip", view="train2", planes=24)).facts
    assert float(facts["PSNR to the run's own picture"].split()[0].rstrip(",")) > 22
    with pytest.raises(InputError, match="no training view 'nobody'"):
        export_mpi(run, ExportRequest(Path("run"), "mpi", tmp_path / "x.zip", view="nobody"))


def test_damaged_files_are_refused(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "planes.zip"
    camera = mean_camera([view.camera for view in scene.train])
    shape = (2, camera.height, camera.width)
    planes = Planes(camera, torch.tensor([1.0, 2.0]), torch.rand(2, 3, *shape[1:]), torch.rand(shape))
    write_mpi(path, PlaneFile(planes, "srgb", "a note"))
    assert read_mpi(path).note == "a note"
    whole = path.read_bytes()
    for broken in (
        whole[: len(whole) // 2],
        b"",
        whole.replace(b'"depth": 2.0', b'"depth": 0.5'),
        whole.replace(b"layers/001", b"layers/007"),
    ):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=r"planes\.zip"):
            read_mpi(path)
