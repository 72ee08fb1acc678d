"""Classes of objects: instances rendered with their own cameras, unseen ones held out, and read back like any data set."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from in_process import work_here

from invgraphics.core import Model, Scene
from invgraphics.core.mesh import Mesh
from invgraphics.errors import InputError
from invgraphics.fields.mesh import MeshFieldConfig
from invgraphics.renderers.surface import SurfaceConfig
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba import cache, llvm, make, maker
from invgraphics.scenes.mitsuba.build import chairs, mugs
from invgraphics.scenes.mitsuba.build.mesh import merge
from invgraphics.scenes.mitsuba.spec import Instances, class_names, description_path, read
from invgraphics.scenes.npz import Npz
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.scenes.open import open_scene, validate

FEW = """views = { train = 2, val = 1, test = 1 }
samples = { train = 1, val = 1, test = 2 }
instances = { train = 2, unseen = 1, observed = 1 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three tiny mugs, the last of them unseen."""
    text = (description_path("mugs")).read_text().replace("size = [64, 64]", "size = [20, 20]")
    lines = [line for line in text.splitlines() if not line.startswith(("views", "samples", "instances"))]
    description = tmp_path_factory.mktemp("class") / "scene.toml"
    description.write_text("\n".join(lines).replace("[rig]", f"{FEW}[rig]"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maker.llvm, "status", lambda: llvm.Status(llvm.PORTABLE, None, "For the test."))
        patch.setenv(cache.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        work_here(patch)
        return make(str(description))


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return open_scene(str(folder))


def test_views_name_their_instances_and_the_unseen_are_held_out(scene: Scene) -> None:
    splits = {split: [view.subject for view in getattr(scene, split)] for split in ("train", "val", "observed", "test")}
    assert splits == {"train": [0, 0, 1, 1], "val": [0, 1], "observed": [2], "test": [2]}
    assert scene.is_class and scene.name == "mugs" and scene.noise_ceiling is not None
    assert len({tuple(view.camera.position.tolist()) for s in splits for view in getattr(scene, s)}) == 8
    assert [view.name for view in scene.train] == ["0000-00", "0000-01", "0001-00", "0001-01"]
    alone = scene.of_subject(2, views=1)
    assert not alone.is_class and len(alone.train) == len(alone.test) == 1 and alone.name == "mugs-2"
    validate(alone)


def test_each_instance_is_the_model_of_its_seed(scene: Scene) -> None:
    """Depth and normals against the library's own ray caster, on the meshes that the seeds make."""
    for view in (scene.train[0], scene.train[2], scene.test[0]):
        assert view.subject is not None and view.depth is not None and view.normal is not None
        mesh = merge(part.mesh for part in mugs.build(view.subject).parts)
        surface = Mesh(torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces))
        model = Model(MeshFieldConfig().from_mesh(surface, scene), SurfaceConfig(supersampling=1).build(scene), scene.bounds)
        picture = model.render(view.camera)
        both = view.depth.isfinite() & (picture.alpha >= 0.5)
        assert float((view.depth.isfinite() == (picture.alpha >= 0.5)).float().mean()) > 0.97
        assert float((picture.depth - view.depth)[both].abs().median()) < 2e-3
        assert picture.normal is not None
        assert float((picture.normal * view.normal).sum(dim=-1)[both].median()) > 0.99


def test_the_background_is_the_description_s(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "grey"))
    table = json.loads((copy / "truth.json").read_text())
    (copy / "truth.json").write_text(json.dumps(table | {"background": [0.5, 0.25, 0.0]}))
    assert open_scene(str(copy)).background.tolist() == [0.5, 0.25, 0.0]


def test_a_class_is_kept_and_read_like_any_data_set(scene: Scene, folder: Path, tmp_path: Path) -> None:
    plain = Npz().load(folder / cache.VIEWS, SceneOptions())
    save_npz(plain, tmp_path / "kept.npz")
    again = Npz().load(tmp_path / "kept.npz", SceneOptions())
    for split in ("train", "val", "observed", "test"):
        views = [getattr(one, split) for one in (scene, again)]
        assert all(torch.equal(a.image, b.image) and a.subject == b.subject for a, b in zip(*views, strict=True))
    small = open_scene(str(folder), SceneOptions(size=10))
    assert small.train[0].camera.width == 10 and small.train[0].depth is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"subject": [0, 0, 0, 1, 1, 1, 0, 0]}, "trained on, too"),
        ({"observed": [0] * 8, "val": [0, 0, 1, 0, 0, 1, 1, 0]}, "without any 'observed' view"),
        ({"val": [0, 0, 1, 0, 0, 1, 0, 1]}, "more than one of"),
        ({"subject": [0.5] * 8}, "one whole number"),
    ],
)
def test_splits_that_would_leak_are_refused(change: dict, sentence: str, folder: Path, tmp_path: Path) -> None:
    with np.load(folder / cache.VIEWS) as arrays:
        table = dict(arrays)
    for key, values in change.items():
        table[key] = np.array(values).astype(table[key].dtype if key != "subject" or max(values) >= 1 else float)
    np.savez(tmp_path / "broken.npz", **table)
    with pytest.raises(InputError, match=sentence):
        Npz().load(tmp_path / "broken.npz", SceneOptions())


def test_numbers_of_instances() -> None:
    assert class_names() == ("chairs", "mugs")
    assert Instances().scaled(18) == Instances(16, 2, 8) and Instances().scaled(2) == Instances(1, 1, 8)
    chairs_of = read(description_path("chairs")).with_instances
    job = maker.planned(chairs_of(18), None, (None, None), None, 0)
    assert job.total == 16 * 17 + 2 * 16
    with pytest.raises(InputError, match="single scene"):
        read(description_path("bricks")).with_instances(18)
    with pytest.raises(InputError, match="at least 2"):
        chairs_of(1)


@pytest.mark.parametrize(("name", "build"), [("chairs", chairs.build), ("mugs", mugs.build)])
def test_instances_differ_and_stay_within_the_box(name: str, build) -> None:
    spec = read(description_path(name))
    extents = []
    for seed in range(0, 144, 4):
        vertices = np.concatenate([part.mesh.vertices for part in build(seed).parts])
        assert (vertices >= np.array(spec.lo)).all() and (vertices <= np.array(spec.hi)).all()
        extents.append(np.ptp(vertices, axis=0))
    assert np.stack(extents).std(axis=0).min() > 0.02
    assert np.array_equal(*(build(7).parts[0].mesh.vertices for _ in range(2)))
