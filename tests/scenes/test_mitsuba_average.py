"""Smaller truth averaged from a larger rendering, and how long rendering is said to take. Renders with the portable variant."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from in_process import work_here

from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba import average, cache, llvm, make, maker
from invgraphics.scenes.mitsuba.folder import psnr
from invgraphics.scenes.mitsuba.forecast import RenderingForecast
from invgraphics.scenes.mitsuba.job import Job, Source
from invgraphics.scenes.mitsuba.larger import averaged
from invgraphics.scenes.mitsuba.spec import Counts, SamplesPerPixel, description_path, read
from invgraphics.scenes.open import open_scene
from invgraphics.scenes.truth import Truth

SCENE = """
name = "tiny"
builder = "materials"
summary = "Small."
stresses = "Nothing."
lo = [-1.05, -1.05, -0.8]
hi = [1.05, 1.05, 0.7]
background = [1.0, 1.0, 1.0]
depth = 2
size = [32, 24]
rig = { kind = "hemisphere", radius = 3.5, fov = 38.0 }
views = { train = 2, val = 0, test = 1 }
samples = { train = 2, val = 2, test = 4 }
"""

LARGE, SMALL = (32, 24), (16, 12)


@pytest.fixture(autouse=True)
def _portable(monkeypatch):
    monkeypatch.setattr(maker.llvm, "status", lambda: llvm.Status(llvm.PORTABLE, None, "For the test."))


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("description") / "scene.toml"
    path.write_text(SCENE)
    return str(path)


def _rendered(scene_file: str, root: Path, **options) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maker.llvm, "status", lambda: llvm.Status(llvm.PORTABLE, None, "For the test."))
        patch.setenv(cache.VARIABLE, str(root))
        work_here(patch)
        return make(scene_file, **options)


@pytest.fixture(scope="module")
def large(scene_file, tmp_path_factory) -> Path:
    return _rendered(scene_file, tmp_path_factory.mktemp("large"))


@pytest.fixture(scope="module")
def small(scene_file, tmp_path_factory) -> Path:
    """Rendered at the small size, with nothing to average from."""
    return _rendered(scene_file, tmp_path_factory.mktemp("small"), size=SMALL)


@pytest.fixture(scope="module")
def made(large, scene_file, tmp_path_factory) -> Path:
    """The small size, averaged."""
    root = tmp_path_factory.mktemp("made")
    shutil.copytree(large, root / "scenes" / large.name)
    return _rendered(scene_file, root, size=SMALL)


@pytest.fixture
def with_large(large, tmp_path, monkeypatch) -> Path:
    """A cache that holds the large rendering."""
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return Path(shutil.copytree(large, tmp_path / "cache" / "scenes" / large.name)).parent


def _arrays(folder: Path, view: str) -> dict[str, np.ndarray]:
    with np.load(folder / f"{view}.npz") as arrays:
        return dict(arrays)


def test_pictures_are_means_of_blocks_and_geometry_is_that_of_a_rendering(made, large, small):
    folder = made
    assert folder.name != small.name
    for view in ("train/0000", "train/0001", "test/0000"):
        ours, theirs, wide = (_arrays(place, view) for place in (folder, small, large))
        means = wide["linear"].reshape(12, 2, 16, 2, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(ours["linear"], means, atol=1e-6)
        for key in ("depth", "normal", "alpha"):
            np.testing.assert_array_equal(ours[key], theirs[key])
    ours, theirs = (json.loads((place / "truth.json").read_text()) for place in (folder, small))
    for key in ("cameras", "size", "bounds", "background"):
        assert ours[key] == theirs[key]
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == {
        path.relative_to(small).as_posix() for path in small.rglob("*")
    }


def test_the_notes_say_what_was_averaged(made, scene_file, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(made.parents[1]))
    notes = Truth().load(made, SceneOptions()).notes
    assert notes["resize"] == "area average of linear light, 32x24 to 16x12"
    assert notes["samples_per_pixel"] == "train 8, val 8, test 16 (averaged; of each rendered pixel: train 2, val 2, test 4)"
    again = Truth().load(made, SceneOptions(size=8)).notes["resize"]
    assert again.startswith("area average of linear light, 32x24 to 16x12; then area average (exact box filter")
    scene = open_scene(scene_file, SceneOptions(size=SMALL, test_views=1))
    assert scene.train[0].depth is not None and scene.train[0].normal is not None
    assert scene.notes == notes


def test_noise_of_averages_is_smaller(scene_file, tmp_path):
    """Halves with known noise, averaged apart: their PSNR is what is stated of the average of the whole."""
    rng = np.random.default_rng(0)
    halves = [np.ones((96, 128, 4), np.float32) for _ in range(2)]
    for half in halves:
        half[..., :3] = 0.4 + 0.02 * rng.standard_normal((96, 128, 3))
    np.savez(tmp_path / "0000.npz", linear=(halves[0] + halves[1]) / 2, half_psnr=psnr(*halves, None))
    spec, samples = read(description_path(scene_file)), SamplesPerPixel(2, 2, 4)
    job = Job(spec, (32, 24), Counts(), samples, 0, llvm.PORTABLE, Source((128, 96), Counts(), samples))
    linear, stated = average.mean_picture(tmp_path / "0000.npz", job)
    blocks = [half.reshape(24, 4, 32, 4, 4).mean(axis=(1, 3)) for half in halves]
    assert stated == pytest.approx(psnr(*blocks, None), abs=0.3)
    np.testing.assert_allclose(linear, (blocks[0] + blocks[1]) / 2, atol=1e-6)


@pytest.fixture
def forbid_processes(monkeypatch):
    def refuse(command, *args, **kwargs):
        raise AssertionError(f"started {command[3]}")

    monkeypatch.setattr(subprocess, "Popen", refuse)


@pytest.mark.usefixtures("with_large", "forbid_processes")
@pytest.mark.parametrize(
    ("options", "process"),
    [
        ({"size": SMALL, "spp": 8}, "average"),  # 2 samples in each of 4 pixels
        ({"size": SMALL, "spp": 9}, "render"),
        ({"size": SMALL, "spp": 2}, "render"),  # more samples than were asked for are other noise
        ({"size": SMALL}, "average"),
        ({"size": (24, 18), "spp": 3}, "render"),  # 2 samples in each of 16/9 pixels are 3.6
        ({"size": SMALL, "train": 1}, "average"),  # the first of more views is the same view
        ({"size": SMALL, "train": 3}, "render"),
        ({"size": SMALL, "seed": 1}, "render"),
        ({"size": (16, 16)}, "render"),  # another shape sees other things
        ({"size": (24, 18)}, "average"),
        ({"size": (64, 48)}, "render"),
        ({"size": LARGE, "spp": 1}, "render"),  # as large, but not larger
    ],
)
def test_only_what_serves_is_averaged(scene_file, options, process, capsys):
    with pytest.raises(AssertionError, match=rf"started invgraphics\.scenes\.mitsuba\.{process}$"):
        make(scene_file, **options)
    assert (" views averaged from those at 32x24 in the cache." in capsys.readouterr().err) == (process == "average")


@pytest.mark.usefixtures("with_large", "forbid_processes")
def test_another_description_is_not_averaged(scene_file, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.replace("depth = 2", "depth = 3"))
    with pytest.raises(AssertionError, match=r"started .*render"):
        make(str(tmp_path), size=SMALL)


def test_averages_are_kept_and_a_rendering_is_preferred(with_large, made, small, scene_file, monkeypatch):
    folder = Path(shutil.copytree(made, with_large / made.name))
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    assert make(scene_file, size=SMALL) == make(scene_file, size=SMALL, spp=8) == folder
    shutil.copytree(small, with_large / small.name)
    assert make(scene_file, size=SMALL) == with_large / small.name


def test_what_was_averaged_before_is_taken_again(with_large, large, scene_file, monkeypatch):
    """A second, smaller source does not change the truth of runs that exist."""
    spec = read(description_path(scene_file))
    job = Job(spec, (8, 6), Counts(2, 0, 1), SamplesPerPixel(2, 2, 4), 0, llvm.PORTABLE)
    first = averaged(job)
    assert first is not None and first.source is not None and first.source.size == LARGE
    (with_large / first.folder_name).mkdir()
    (with_large / first.folder_name / "truth.json").write_text(json.dumps({"schema": 1, "files": {}, "averaged_from": {}}))
    middle = Job(spec, SMALL, Counts(2, 0, 1), SamplesPerPixel(2, 2, 4), 0, llvm.PORTABLE)
    table = json.loads((large / "truth.json").read_text()) | {"size": list(SMALL), "files": {}}
    (with_large / middle.folder_name).mkdir()
    (with_large / middle.folder_name / "truth.json").write_text(json.dumps(table))
    assert averaged(job) == first
    shutil.rmtree(with_large / first.folder_name)
    second = averaged(job)
    assert second is not None and second.source is not None and second.source.size == SMALL


def test_rendered_jobs_keep_their_keys(scene_file):
    """Whatever is in people's caches was kept under the hash of a table without a source."""
    job = Job(read(description_path(scene_file)), SMALL, Counts(2, 0, 1), SamplesPerPixel(2, 2, 4), 0, llvm.PORTABLE)
    assert "source" not in job.table()


class Told:
    """A forecast with a clock of one's own."""

    def __init__(self, folder: Path) -> None:
        self.now, self.sentences = 0.0, []
        spec = read(description_path("bricks"))
        job = Job(spec, (80, 60), Counts(3, 1, 2), SamplesPerPixel(100, 50, 400), 0, llvm.PORTABLE)
        self.forecast = RenderingForecast(job, folder, lambda *_: None, self.sentences.append, lambda: self.now)

    def view(self, what: str, seconds: float) -> None:
        self.forecast(0, 6, what)
        self.now += seconds


def test_the_time_is_said_after_the_first_view(tmp_path):
    told = Told(tmp_path)
    told.view("train 0000", 60.0)
    assert told.sentences == []
    told.view("train 0001", 1.0)
    # 60 s for 100 samples: 1050 are left, of two training views, one for validation and two for tests.
    (sentence,) = told.sentences
    assert sentence.startswith("bricks at 80x60: 6 views, about 10 min on ")
    assert sentence.endswith("; cached afterwards.")
    for what in ("train 0002", "val 0000"):
        told.view(what, 1.0)
    assert len(told.sentences) == 1


def test_a_short_first_view_is_compilation(tmp_path):
    told = Told(tmp_path)
    for what, seconds in (("train 0000", 4.0), ("train 0001", 1.0), ("train 0002", 1.0)):
        told.view(what, seconds)
    assert "6 views, about 10 s on " in told.sentences[0]  # 950 samples at 1 s for 100


def test_views_that_are_there_are_not_timed(tmp_path):
    (tmp_path / "train").mkdir()
    for index in range(2):
        (tmp_path / "train" / f"000{index}.npz").touch()
    told = Told(tmp_path)
    for what, seconds in (("train 0000", 0.0), ("train 0001", 0.0), ("train 0002", 20.0), ("val 0000", 1.0)):
        told.view(what, seconds)
    assert "4 views, about 3 min on " in told.sentences[0]  # 850 samples at 20 s for 100
