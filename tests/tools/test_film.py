"""Films and snapshots: paths through a scene, time-lapses of a fit, caps and starts that a command line asks for."""

import shutil
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from training_fixtures import SMALL

from invgraphics.core import Camera, Model, Rendering
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.recipes.recipe import load_method
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT, RunFolder
from invgraphics.testing import toy_scene
from invgraphics.tools.film import FilmRequest, film, path_explanation
from invgraphics.tools.paths import classify_capture, interpolate, orbit, spiral

METHOD = "splatting/gaussians"


def _request(toy_folder: Path, out: Path, **more) -> FitRequest:
    base = {"method": METHOD, "scene": str(toy_folder), "out": str(out), "budget": "20steps", "overrides": tuple(SMALL[METHOD])}
    return FitRequest(**base | {"snapshots": 4} | more)


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fit_run(_request(toy_folder, tmp_path_factory.mktemp("films") / "run"))


def frames_of(path: Path) -> np.ndarray:
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


def test_orbit_looks_at_the_middle_from_all_around() -> None:
    scene = toy_scene(views=8, size=8)
    path = orbit(scene, 12)
    pixels = torch.stack([camera.project(scene.bounds.centre[None])[0][0] for camera in path])
    torch.testing.assert_close(pixels, path[0].principal_point.expand(12, 2), atol=1e-4, rtol=0)
    positions = torch.stack([camera.position for camera in path])
    # A circle: in one plane, around its own middle, and round the scene's.
    middle = positions.mean(dim=0)
    assert float(torch.linalg.svdvals(positions - middle)[2]) < 1e-4
    around = (positions - middle).norm(dim=1)
    assert float(around.max() - around.min()) < 1e-4
    distance = positions.norm(dim=1)
    assert float(distance.max() - distance.min()) < 1e-4
    assert 2.0 < float(distance[0]) < 4.0
    assert all(float(camera.cam_to_world[:3, 1] @ torch.tensor([0.0, 0.0, 1.0])) < 0 for camera in path)


def test_interpolation_comes_by_photographs() -> None:
    scene = toy_scene(views=8, size=8)
    path = interpolate(scene, 80)
    for camera in path:
        rotation = camera.cam_to_world[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    # Eight stops in eighty pictures: every tenth is a photograph's camera.
    poses = torch.stack([view.camera.cam_to_world for view in scene.train])
    for camera in path[::10]:
        assert float((poses - camera.cam_to_world).abs().amax(dim=(1, 2)).min()) < 1e-4
    steps = torch.stack([camera.position for camera in path]).diff(dim=0).norm(dim=1)
    assert float(steps.max()) < 1.0


def _captured(eyes: torch.Tensor, outwards: bool = False):
    """The toy scene with training cameras at ``eyes``, which look at the origin or away from it."""
    scene = toy_scene(views=4, size=8)
    poses = [look_at(eye, 2 * eye if outwards else torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes]
    views = tuple(replace(scene.train[0], camera=scene.train[0].camera.moved(pose)) for pose in poses)
    return scene.with_views(train=views)


def _ring(first: float, last: float, count: int = 12) -> torch.Tensor:
    azimuth = torch.deg2rad(torch.linspace(first, last, count))
    return torch.stack([3 * azimuth.cos(), 3 * azimuth.sin(), torch.ones(count)], dim=1)


@pytest.mark.parametrize(
    ("eyes", "outwards", "path"),
    [
        (_ring(0, 330), False, "orbit"),
        (_ring(-10, 250), False, "orbit"),
        (_ring(-75, 75), False, "interpolate"),
        (_ring(0, 330), True, "interpolate"),
        (_ring(-20, 20), False, "spiral"),
        (torch.tensor([[3.0, 0.3 * x, 0.2 * y] for x in (-1, 0, 1) for y in (-1, 0, 1)]), False, "spiral"),
        (torch.tensor([[0.2 * x, 0.01 + 0.2 * y, 3.0] for x in (-1, 0, 1) for y in (-1, 0, 1)]), False, "spiral"),
    ],
    ids=["ring", "most of a ring", "half a ring", "outwards", "arc", "window", "from above"],
)
def test_path_suits_the_capture(eyes: torch.Tensor, outwards: bool, path: str) -> None:
    assert classify_capture(_captured(eyes, outwards)).path == path


def test_spiral_stays_in_the_window_and_looks_at_the_subject() -> None:
    """LLFF's closed path: its cameras lie within the photographs' window, and each sees the origin in its middle."""
    eyes = torch.tensor([[3.0, 0.3 * x, 0.2 * y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    path = spiral(_captured(eyes), 48)
    position = torch.stack([camera.position for camera in path])
    assert float(position[:, 1].abs().max()) == pytest.approx(0.3, abs=0.02)
    assert float(position[:, 2].abs().max()) == pytest.approx(0.2, abs=0.02)
    assert float(position[:, 0].min()) > 2.5 and float(position[:, 0].max()) < 3.5
    for camera in path:
        pixel, _ = camera.project(torch.zeros(1, 3))
        torch.testing.assert_close(pixel[0], camera.principal_point, atol=0.2, rtol=0)
        assert float(camera.cam_to_world[2, 1]) < -0.9
    steps = torch.cat([position, position[:1]]).diff(dim=0).norm(dim=1)
    assert float(steps.max()) < 2 * float(steps.mean())


def test_headings_that_cancel_leave_a_way_up() -> None:
    """A drone that looks straight down and turns round at every other photograph."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    scene = toy_scene(views=4, size=8)
    views = []
    for index, x in enumerate((-0.6, -0.2, 0.2, 0.6)):
        pose = down @ turned if index % 2 else down.clone()
        pose[:3, 3] = torch.tensor([x, 0.0, 3.0])
        views.append(replace(scene.train[0], camera=scene.train[0].camera.moved(pose)))
    for path in (spiral, orbit):
        for camera in path(scene.with_views(train=tuple(views)), 6):
            rotation = camera.cam_to_world[:3, :3]
            torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_film_says_why_it_takes_its_path(run: Path, tmp_path: Path, capsys) -> None:
    film(FilmRequest(run, tmp_path / "new" / "folder" / "a.mp4", frames=2))
    assert (tmp_path / "new" / "folder" / "a.mp4").is_file()
    assert "Path: orbit, as the photographs surround the subject." in capsys.readouterr().err
    film(FilmRequest(run, tmp_path / "a.mp4", "spiral", frames=2))
    assert "Path: spiral." in capsys.readouterr().err


def test_orbit_of_a_forward_facing_capture_is_warned_of() -> None:
    words = path_explanation("orbit", classify_capture(_captured(_ring(-20, 20))))
    assert "elsewhere nothing was fitted" in words and "--path spiral" in words


def test_snapshots_cover_the_fit_and_end_with_its_model(run: Path) -> None:
    snapshots = RunFolder(run).snapshots
    assert [path.stem for path in snapshots] == ["0000", "0001", "0002", "0003", "0004"]
    steps = [int(checkpoint.load(path)["fit"]["steps"]) for path in snapshots]
    assert steps == [0, 5, 10, 15, 20]
    last, whole = checkpoint.load(snapshots[-1]), checkpoint.load(run / CHECKPOINT)
    assert torch.equal(last["field"]["means"], whole["field"]["means"])


def test_time_lapse_shows_pictures_beside_ellipsoids(run: Path, tmp_path: Path) -> None:
    out = film(FilmRequest(run, tmp_path / "lapse.mp4", "timelapse", rate=10, size=33))
    frames = frames_of(out)
    assert frames.shape[:3] == (5 + 15, 34, 66)
    assert float(np.abs(frames[0].astype(float) - frames[4]).mean()) > 0.5
    assert float(np.abs(frames[4].astype(float) - frames[-1]).mean()) < 1
    left, right = frames[4][:, :33].astype(float), frames[4][:, 33:].astype(float)
    assert float(np.abs(left - right).mean()) > 0.5


@pytest.mark.parametrize("path", ["orbit", "spiral", "interpolate"])
def test_paths_become_films(run: Path, tmp_path: Path, path) -> None:
    frames = frames_of(film(FilmRequest(run, tmp_path / "a.mp4", path, frames=6)))
    assert frames.shape == (6, 24, 24, 3)
    # A sixth of the path on: a closed spiral of two turns is back at its first camera half-way.
    assert float(np.abs(frames[0].astype(float) - frames[1]).mean()) > 0.5


@pytest.mark.parametrize("size", [(64, 32), (16, 48), (24, 24)])
def test_films_of_another_shape_are_not_stretched(run: Path, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """They show the square photograph's view in their middle, and more along the longer side."""
    seen: list[Camera] = []

    def render(model: Model, camera: Camera, **more: bool) -> Rendering:
        seen.append(camera)
        empty = torch.zeros(camera.height, camera.width)
        return Rendering(torch.zeros(*empty.shape, 3), empty, empty)

    own = open_fitted(run).in_its_frame().scene.test[0].camera
    monkeypatch.setattr(Model, "render", render)
    film(FilmRequest(run, run.parent / "shaped.mp4", "orbit", frames=2, size=size))
    scale = min(size) / 24
    for camera in seen:
        assert (camera.width, camera.height) == size
        torch.testing.assert_close(camera.focal, own.focal * scale)
        torch.testing.assert_close(camera.principal_point - torch.tensor(size) / 2, (own.principal_point - 12) * scale)
    assert len(seen) == 2


def test_bad_requests_are_refused(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    bare = fit_run(_request(toy_folder, tmp_path / "bare", budget="1steps", snapshots=0))
    for request, words in (
        (FilmRequest(bare, tmp_path / "a.mp4", "timelapse"), "no snapshots"),
        (FilmRequest(run, tmp_path / "file" / "a.mp4"), "cannot be made"),
        (FilmRequest(run, tmp_path / "a.mp4", "timelapse", view=99), "--view"),
    ):
        with pytest.raises(InputError, match=words):
            film(request)
    with pytest.raises(InputError, match="mp4"):
        FilmRequest(run, tmp_path / "a.gif")
    assert not (tmp_path / "a.mp4").exists()


def test_a_cap_reaches_every_part() -> None:
    recipe = load_method(METHOD, None, ["max_primitives=700"]).recipe
    assert (recipe.field.count, recipe.field.max_init, recipe.hooks[1].max_primitives) == (700, 700, 700)
    assert load_method("splatting/gaussians-mcmc", None, ["max_primitives=90000"]).recipe.hooks[1].max_primitives == 90000
    load_method("volumetric/hash", None, ["max_primitives=700"])  # has nothing to cap
    with pytest.raises(InputError, match="max_primitives"):
        load_method(METHOD, None, ["max_primitives=0"])


def test_memory_is_predicted_and_too_much_refused(toy_folder: Path, tmp_path: Path, capsys) -> None:
    fit_run(_request(toy_folder, tmp_path / "a", budget="1steps"))
    assert "up to 40,000 primitives in about" in capsys.readouterr().err
    greedy = (*SMALL[METHOD], "max_primitives=1000000000")
    with pytest.raises(InputError, match="GB of memory"):
        fit_run(_request(toy_folder, tmp_path / "b", budget="1steps", overrides=greedy))


def test_gaussians_start_from_another_run(toy_folder: Path, tmp_path: Path) -> None:
    first = {"method": "volumetric/hash", "overrides": (*SMALL["volumetric/hash"],), "budget": "3steps"}
    source = fit_run(_request(toy_folder, tmp_path / "hash", **first))
    items = (*SMALL[METHOD], "field.init=field", f"field.source={source}", "field.max_init=120")
    folder = fit_run(_request(toy_folder, tmp_path / "splats", budget="1steps", overrides=items))
    means = checkpoint.load(RunFolder(folder).snapshots[0])["field"]["means"]
    assert len(means) == 120
    fitted = open_fitted(source)
    again = {}
    config = load_method(METHOD, None, items).recipe.field
    for seed in (0, 1):  # the run's own seed, which draws the same points, and another
        torch.manual_seed(seed)
        again[seed] = config.converted(fitted.model.field, fitted.scene).means
    assert torch.equal(means, again[0])
    assert not torch.equal(means, again[1])
    refined = ("training.poses.optimise=true", "training.poses.test_steps=2")
    moved = fit_run(_request(toy_folder, tmp_path / "moved", **(first | {"overrides": (*first["overrides"], *refined)})))
    features = ("field.width=8", "field.features=8", "renderer.features=8", "renderer.width=8", "batches.rays=64")
    without = fit_run(_request(toy_folder, tmp_path / "srn", method="learned/srn", budget="1steps", overrides=features))
    other_scene = shutil.copytree(toy_folder, tmp_path / "another-scene")
    elsewhere = fit_run(_request(other_scene, tmp_path / "elsewhere", **first))
    wrongs = (
        (tmp_path / "none", "is not a run"),
        (without, "not density and radiance"),
        (moved, "has refined its cameras' poses"),
        (elsewhere, "is a run on"),
    )
    for wrong, words in wrongs:
        items = (*SMALL[METHOD], "field.init=field", f"field.source={wrong}")
        with pytest.raises(InputError, match=words):
            fit_run(_request(toy_folder, tmp_path / "other", budget="1steps", overrides=items))
