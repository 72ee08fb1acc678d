"""`make`: bitwise reproducible, cached, resumable, and clear about what goes wrong. Renders with the portable variant."""

import json
import os
import shutil
import subprocess
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch
from in_process import work_here
from PIL import Image

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.experiments.identity import truth_digest
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba import cache, llvm, make, maker
from invgraphics.scenes.open import open_scene

PROBE = llvm.status  # the fixture below replaces the attribute

SCENE = """
name = "tiny"
builder = "materials"
summary = "Small."
stresses = "Nothing."
lo = [-1.05, -1.05, -0.8]
hi = [1.05, 1.05, 0.7]
background = [1.0, 1.0, 1.0]
depth = 3
size = [20, 16]
rig = { kind = "hemisphere", radius = 3.5, fov = 38.0 }
views = { train = 2, val = 1, test = 1 }
samples = { train = 2, val = 1, test = 4 }
"""


@pytest.fixture(autouse=True)
def _portable(monkeypatch):
    monkeypatch.setattr(maker.llvm, "status", lambda: llvm.Status(llvm.PORTABLE, None, "For the test."))


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("description") / "scene.toml"
    path.write_text(SCENE)
    return str(path)


@pytest.fixture(scope="module")
def rendered(scene_file, tmp_path_factory) -> Path:
    """A rendered scene, in a cache of its own that no test writes to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maker.llvm, "status", lambda: llvm.Status(llvm.PORTABLE, None, "For the test."))
        patch.setenv(cache.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        work_here(patch)
        return make(scene_file)


@pytest.fixture
def fresh(tmp_path, monkeypatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "scenes"


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _copy(rendered: Path, scenes: Path) -> Path:
    return Path(shutil.copytree(rendered, scenes / rendered.name))


@pytest.fixture
def forbid_rendering(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a rendering process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)


def test_folder_has_what_it_promises(rendered):
    truth = json.loads((rendered / "truth.json").read_text())
    assert {split: len(views) for split, views in truth["cameras"].items()} == {"train": 2, "val": 1, "test": 1}
    assert set(_contents(rendered)) == {
        "truth.json", "points.npz", "mesh.ply", "transforms_train.json", "transforms_val.json", "transforms_test.json",
        *(f"{view}.{kind}" for view in ("train/0000", "train/0001", "val/0000", "test/0000") for kind in ("png", "npz")),
    }  # fmt: skip
    assert 5 < truth["noise_ceiling"] < 60
    assert truth["samples_per_pixel"] == {"train": 2, "val": 1, "test": 4}
    assert truth["background"] == [1.0, 1.0, 1.0]


def test_png_is_straight_srgb_of_the_linear_values(rendered):
    for picture in rendered.glob("*/*.png"):
        rgba = np.asarray(Image.open(picture))
        with np.load(picture.with_suffix(".npz")) as arrays:
            linear = arrays["linear"].astype(np.float64)
        assert rgba.shape == linear.shape == (16, 20, 4)
        alpha = linear[..., 3]
        assert (alpha == 0).any()
        assert (alpha == 1).any()
        straight = np.clip(
            np.divide(linear[..., :3], alpha[..., None], where=alpha[..., None] > 0, out=np.zeros((16, 20, 3))), 0, 1
        )
        srgb = np.where(straight <= 0.0031308, 12.92 * straight, 1.055 * straight ** (1 / 2.4) - 0.055)
        assert np.abs(rgba[..., :3] - 255 * srgb).max() <= 0.51
        assert np.abs(rgba[..., 3] - 255 * alpha).max() <= 0.51


def test_points_are_seen_where_they_are(rendered):
    """Project the points into a training view: none lies in front of the depth that the view records."""
    truth = json.loads((rendered / "truth.json").read_text())
    table = truth["cameras"]["train"][0]
    pose, focal, centre = (torch.tensor(table[key], dtype=torch.float64) for key in ("cam_to_world", "focal", "centre"))
    camera = Camera(pose, focal, centre, 20, 16)
    with np.load(rendered / "points.npz") as points, np.load(rendered / "train/0000.npz") as arrays:
        position, depth = torch.from_numpy(points["position"]).double(), arrays["depth"]
        assert ((points["rgb"] >= 0) & (points["rgb"] <= 1)).all()
    pixel, z = camera.project(position)
    distance = (position - camera.position).norm(dim=1)
    own = ((pixel - pixel.floor() - 0.5).abs() < 1e-3).all(dim=1)  # points of this view lie on its pixel centres
    assert (z > 0).all()
    assert own.sum() >= np.isfinite(depth).sum()
    column, row = pixel[own].floor().long().T
    seen = depth[row.numpy(), column.numpy()]
    assert (distance[own].numpy() > seen - 1e-3).all()
    assert np.isclose(distance[own].numpy(), seen, atol=1e-4).sum() == np.isfinite(depth).sum()


def test_transforms_tell_other_programs_the_same_cameras(rendered):
    truth = json.loads((rendered / "truth.json").read_text())
    other = json.loads((rendered / "transforms_test.json").read_text())
    ours = np.array(truth["cameras"]["test"][0]["cam_to_world"])
    theirs = np.array(other["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(theirs[:3], ours[:3] * [1, -1, -1, 1])
    focal = 0.5 * 20 / np.tan(other["camera_angle_x"] / 2)
    assert focal == pytest.approx(truth["cameras"]["test"][0]["focal"][0])
    assert (rendered / f"{other['frames'][0]['file_path']}.png").is_file()


def test_interrupted_rendering_resumes_to_the_same_bytes(rendered, fresh, scene_file, monkeypatch):
    """Also the proof of determinism: another process in another folder begins the very same files, and this one ends them."""

    def interrupt(done, total, what):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(scene_file, progress=interrupt)
    kept = next(fresh.glob("*.partial")) / "train/0000.npz"
    first = kept.stat().st_mtime_ns
    assert not (fresh / rendered.name).exists()
    reports = []
    work_here(monkeypatch)
    folder = make(scene_file, progress=lambda *report: reports.append(report))
    assert (folder / "train/0000.npz").stat().st_mtime_ns == first
    assert _contents(folder) == _contents(rendered)
    assert reports[0] == (0, 4, "train 0000")
    assert reports[-1][:2] == (4, 4)


def test_a_kill_while_the_truth_is_written_costs_no_view(rendered, fresh, scene_file, monkeypatch):
    """All views and the half-written ``truth.json`` are there; the second run ends with a folder that counts as whole."""
    partial = shutil.copytree(rendered, fresh / f"{rendered.name}.partial")
    (partial / "truth.json").rename(partial / "truth.json.tmp")
    before = (partial / "train/0000.npz").stat().st_mtime_ns
    work_here(monkeypatch)
    folder = make(scene_file)
    assert (folder / "train/0000.npz").stat().st_mtime_ns == before
    assert cache.read_truth(folder) is not None
    assert _contents(folder) == _contents(rendered)


def test_a_full_disk_is_named_and_rendering_goes_on_when_there_is_room(rendered, scene_file, tmp_path, monkeypatch):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False).returncode:
        pytest.skip("mounting a small tmpfs needs root")
    monkeypatch.setenv(cache.VARIABLE, str(disk))
    ballast = disk / "ballast"
    try:
        ballast.write_bytes(bytes(shutil.disk_usage(disk).free - 28_000))
        with pytest.raises(InputError, match=f"'{disk}.*' cannot be written: the disk is full"):
            make(scene_file)
        assert len(list(disk.rglob("*.npz"))) in (1, 2, 3) and not list(disk.rglob("*.tmp"))
        with pytest.raises(InputError, match=f"'{disk}.*' cannot be written: the disk is full"):
            cache.copy(rendered, disk / "copy")
        assert not list(disk.glob("*copy*"))
        ballast.unlink()
        work_here(monkeypatch)
        assert _contents(make(scene_file)) == _contents(rendered)
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.usefixtures("forbid_rendering")
def test_cache_hit_renders_nothing(rendered, fresh, scene_file, tmp_path):
    folder = _copy(rendered, fresh)
    assert make(scene_file) == folder
    assert make(scene_file, size=(20, 16), train=2, test=1, spp=2) == folder
    target = tmp_path / "mine"
    assert make(scene_file, out=target) == target
    assert _contents(target) == _contents(rendered)
    assert make(scene_file, out=target) == target  # already there


def test_fewer_test_views_are_taken_from_the_cache(fresh, tmp_path, monkeypatch):
    """What was rendered for more test views has those that a rendering of fewer makes, to the bit."""
    work_here(monkeypatch)
    more = tmp_path / "scene.toml"
    more.write_text(SCENE.replace("test = 1", "test = 2"))
    fewer = make(str(more), test=1)
    kept = fewer.rename(tmp_path / "fewer")
    few = open_scene(str(kept), SceneOptions(test_views=1))
    make(str(more))
    monkeypatch.setattr(maker, "run_worker", lambda *args, **kwargs: pytest.fail("rendered again"))
    chosen = open_scene(str(more), SceneOptions(test_views=1))
    assert not fewer.exists()
    assert truth_digest(chosen) == truth_digest(few)
    assert len(chosen.test) == 1
    for split in ("train", "val", "test"):
        for ours, theirs in zip(getattr(chosen, split), getattr(few, split), strict=True):
            assert torch.equal(ours.image, theirs.image)
            assert torch.equal(ours.camera.cam_to_world, theirs.camera.cam_to_world)
    with pytest.raises(pytest.fail.Exception, match="rendered again"):
        open_scene(str(more), SceneOptions(test_views=3))


def test_damaged_cache_is_rendered_again(rendered, fresh, scene_file, monkeypatch):
    folder = _copy(rendered, fresh)
    picture = folder / "test/0000.png"
    picture.write_bytes(picture.read_bytes()[:100])
    (folder / "stray.txt").write_text("not ours")

    def render(module, partial, *_, **__):
        assert module.endswith(".render") and [path.name for path in partial.iterdir()] == ["job.json"]
        shutil.copytree(rendered, partial, dirs_exist_ok=True)

    monkeypatch.setattr(maker, "run_worker", render)
    assert make(scene_file) == folder
    assert _contents(folder) == _contents(rendered)


@pytest.mark.usefixtures("fresh", "forbid_rendering")
def test_whatever_matters_changes_the_key(rendered, scene_file):
    for option in ({"size": (16, 16)}, {"train": 3}, {"test": 2}, {"spp": 4}, {"seed": 1}):
        with pytest.raises(AssertionError, match="started"):
            make(scene_file, **option)


@pytest.mark.usefixtures("forbid_rendering")
@pytest.mark.parametrize(
    ("option", "word"),
    [
        ({"size": (4, 20)}, "size"),
        ({"train": 0}, "training"),
        ({"test": -1}, "test"),
        ({"spp": 0}, "samples"),
        ({"seed": -1}, "seed"),
        ({"size": (1_000_000, 1_000_000)}, "of memory"),
        ({"test": 1_000_000_000_000}, "of memory"),
    ],
)
def test_impossible_options_are_refused(fresh, scene_file, option, word):
    with pytest.raises(InputError, match=word):
        make(scene_file, **option)


@pytest.mark.usefixtures("fresh")
def test_unknown_scene():
    with pytest.raises(
        InputError, match=r"bricks, chairs, cloud, cloud-1, cloud-27, cloud-3, cloud-81, fence, materials, mugs, room"
    ):
        make("lego")


def test_cache_that_cannot_be_written(tmp_path, monkeypatch, scene_file):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "file"))
    with pytest.raises(InputError, match=cache.VARIABLE):
        make(scene_file)


def test_copy_does_not_overwrite_other_things(rendered, fresh, scene_file, tmp_path):
    _copy(rendered, fresh)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match="mine"):
        make(scene_file, out=tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "precious"


@pytest.mark.usefixtures("fresh")
def test_surfaces_outside_the_box_are_reported(tmp_path, monkeypatch):
    work_here(monkeypatch)
    (tmp_path / "scene.toml").write_text(SCENE.replace("[1.05, 1.05, 0.7]", "[0.3, 1.05, 0.7]"))
    with pytest.raises(InputError, match="Widen 'lo' and 'hi'") as caught:
        make(str(tmp_path))
    assert "[-0.846, -0.979, -0.619]" in caught.value.sentence


@pytest.mark.usefixtures("fresh")
def test_a_renderer_that_dies_is_reported_in_one_line(scene_file, monkeypatch):
    monkeypatch.setattr(maker.llvm, "status", lambda: llvm.Status("no_such_variant", None, ""))
    with pytest.raises(InputError, match="tiny") as caught:
        make(scene_file)
    assert len(str(caught.value).splitlines()) <= 2


def _wait_for_lock(path: Path, said: Connection) -> None:
    said.recv()
    with cache.locked(path, waiting=lambda: said.send("waiting")):
        said.send("in")


def test_second_process_waits_for_the_first(fresh):
    fresh.mkdir(parents=True)
    told, (mine, theirs) = [], Pipe()
    # Forked, before there is a lock to inherit: importing torch takes longer than all the rest.
    other = get_context("fork").Process(target=_wait_for_lock, args=(fresh / "scene", theirs))
    other.start()
    with cache.locked(fresh / "scene", waiting=lambda: told.append("first")):
        mine.send("go")
        assert mine.recv() == "waiting"
        assert not mine.poll(0.2)
    assert mine.recv() == "in"
    other.join()
    assert other.exitcode == 0
    assert told == []


@pytest.mark.slow
def test_the_fast_variant_is_reproducible_too(tmp_path, monkeypatch, scene_file):
    status = PROBE()
    if status.variant != llvm.FAST:
        pytest.skip(status.reason)
    monkeypatch.setattr(maker.llvm, "status", lambda: status)
    folders = []
    for number in range(2):
        monkeypatch.setenv(cache.VARIABLE, str(tmp_path / str(number)))
        folders.append(make(scene_file))
    assert _contents(folders[0]) == _contents(folders[1])
